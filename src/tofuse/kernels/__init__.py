"""What Numba compiles: plain functions over arrays, below every other room.

A kernel takes and returns arrays, knows nothing of the package's types, releases the GIL, and
has a slow NumPy twin in the tests.
"""
