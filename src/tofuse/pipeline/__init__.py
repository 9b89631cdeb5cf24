"""The engine: a configuration of parts, the online mapper, and the complete run."""
