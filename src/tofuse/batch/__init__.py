"""Many recordings as jobs of their own, that can be resumed: here, or on a Dask cluster."""
