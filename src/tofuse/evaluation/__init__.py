"""How good a trajectory is: against a reference, and by how well the images agree."""
