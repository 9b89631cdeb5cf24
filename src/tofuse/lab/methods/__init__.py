"""Methods of the literature that no named configuration uses.

Each is a regular part: a `--config` file names it, and a test verifies its paper's claims.
"""
