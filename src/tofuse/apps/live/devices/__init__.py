"""Connected cameras, one module each, by their makers' packages."""
