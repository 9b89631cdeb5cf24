"""Files of the trade: PLY clouds, TUM trajectories, images; written beside, then renamed."""
