"""Several depth cameras that are fixed to each other: where they are, and what they see together."""
