"""What a camera's own recordings tell about it."""
