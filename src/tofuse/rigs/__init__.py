"""Several depth cameras that are fixed to each other: where they are, what they see together."""
