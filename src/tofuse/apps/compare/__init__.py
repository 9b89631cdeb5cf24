"""Deviations of a result from a reference, with their uncertainty: `tofuse compare` and `repeat`."""
