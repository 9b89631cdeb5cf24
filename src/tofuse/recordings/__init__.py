"""Views and recordings, and one reader for each format."""
