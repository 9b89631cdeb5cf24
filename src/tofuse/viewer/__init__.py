"""`tofuse view`: the report of a result in the browser; `run --view`: a run while it works."""
