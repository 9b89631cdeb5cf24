"""Attacks on the boundary of the program, for `attack.py` and for the tests."""
