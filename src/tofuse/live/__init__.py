"""Frames as they come: cameras that are plugged in, and recordings played like one."""
