"""Calibration of a camera from its own recordings: lens, range errors, noise."""
