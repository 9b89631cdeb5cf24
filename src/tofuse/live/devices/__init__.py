"""One module for each maker's Python package; see `tofuse.live.device.Device`."""
