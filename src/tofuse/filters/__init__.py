"""Filters: each looks at one view and says which of its points to keep (section 2.8)."""
