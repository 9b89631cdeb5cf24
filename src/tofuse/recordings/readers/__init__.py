"""The readers, one file each; all modules here are imported when a recording is opened."""
