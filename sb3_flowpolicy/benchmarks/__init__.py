"""Benchmarks of updates, learning, acting, environments and flows, each with a baseline."""
