"""Shared by several packages: argument checks, files, vectorized environments."""
