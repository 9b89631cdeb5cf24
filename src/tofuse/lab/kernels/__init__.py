"""What Numba compiles for the simulator and for methods of the laboratory."""
