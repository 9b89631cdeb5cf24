"""Loads what the readers need, for processes that are forked from the one that imports this."""

from attacks import mutation

mutation.subjects()
