"""Corrections: each removes one systematic error from a view before it is filtered."""
