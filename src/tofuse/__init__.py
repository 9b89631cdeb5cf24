"""tofuse: recordings of Time-of-Flight cameras into one consistent 3D model and a trajectory."""
