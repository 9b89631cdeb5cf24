"""Kernels compiled by Numba: plain functions over arrays, on which all other packages build.

A kernel takes and returns arrays, does not depend on types of other packages, releases the GIL,
and is compared with a slow NumPy reference in the tests.
"""
