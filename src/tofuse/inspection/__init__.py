"""Inspection of recordings: facts and faults."""
