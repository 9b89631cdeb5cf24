"""Laboratory: simulator, demo, experiments of the thesis, and methods of the literature.

The pipeline needs none of it; only the command line and the registry of parts refer to it.
"""
