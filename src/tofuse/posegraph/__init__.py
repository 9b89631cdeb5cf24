"""Poses and what was measured between them: loops, optimisers, g2o files."""
