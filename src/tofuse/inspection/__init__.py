"""What a recording is, and what is wrong with it."""
