"""A ToF camera simulator: the package's source of ground truth."""
