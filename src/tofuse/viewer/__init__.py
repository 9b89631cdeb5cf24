"""`tofuse view`: a result in the browser, and a run while it grows."""
