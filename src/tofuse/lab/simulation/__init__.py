"""A ToF camera simulator: the package's own source of truth."""
