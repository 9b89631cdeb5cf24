"""Numba kernels of the simulator and of the laboratory's methods."""
