"""Methods of the literature that no named configuration uses.

Each is a part like any other: a `--config` file names it, and a test shows what its paper claims.
"""
