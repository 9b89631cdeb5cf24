"""Registration of one pair of views, put together from small parts (section 2.9)."""
