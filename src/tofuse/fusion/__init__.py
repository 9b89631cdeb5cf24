"""From poses and views to one model."""
