"""The Tunnel: stay on a narrow path while steps are many times longer than it is wide."""
