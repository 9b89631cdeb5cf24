"""The functions of `import tofuse` that make and load results.

They do what the commands do, without an output folder: the `Result` that they return can save, show
and evaluate itself.
"""
