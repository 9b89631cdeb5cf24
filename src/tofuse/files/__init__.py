"""File formats: geometry, trajectories, images and tables; atomic writes."""
