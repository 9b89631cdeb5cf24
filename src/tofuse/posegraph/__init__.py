"""Poses and measurements between them: loops, optimisers, g2o files."""
