"""Rigs of depth cameras that are fixed to each other: calibration, checks, reconstruction."""
