"""The readers, one file each; every module in here is imported when a recording is opened."""
