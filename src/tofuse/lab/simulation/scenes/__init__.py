"""The scenes: one module for each group, whose function `plan` builds it."""
