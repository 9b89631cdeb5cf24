"""Chapters 4 and 5 of the thesis, run again."""
