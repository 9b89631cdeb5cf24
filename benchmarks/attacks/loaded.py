"""Imports all modules of the readers, in the process from which the workers are forked."""

from attacks import mutation

mutation.subjects()
