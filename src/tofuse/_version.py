"""The version, in the one place that the build and `run.json` read."""

__version__ = "0.3.0"
