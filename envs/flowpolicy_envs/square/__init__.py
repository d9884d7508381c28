"""The Square: four fingers hold an object by force and move it without letting go."""
