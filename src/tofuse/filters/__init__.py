"""Filters: each computes a mask of the points of a view to keep (section 2.8)."""
