"""The scenes: one module for each group, with a function `plan` that lays it out."""
