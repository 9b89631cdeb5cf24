"""From pairs to a sequence: one pose for each frame as it arrives."""
