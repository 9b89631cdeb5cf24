"""Reproduction of chapters 4 and 5 of the thesis, and measures of errors."""
