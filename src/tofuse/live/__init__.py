"""Live frames: connected cameras, and recordings played like one."""
