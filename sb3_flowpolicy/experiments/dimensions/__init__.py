"""The diagonal tunnel as dimensions grow."""
