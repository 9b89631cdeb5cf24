"""Formats: recordings, cameras, poses, clouds and images as files.

It knows the engine's types, and nothing of runs, output folders or the command line.
"""
