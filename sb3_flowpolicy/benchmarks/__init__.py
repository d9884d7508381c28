"""How fast updates, learning, environments and flows are, next to their peers."""
