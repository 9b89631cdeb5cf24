"""Many recordings as separate, resumable jobs: on this machine, or on a Dask cluster."""
