"""What experiments with the program need, and its use does not: nothing outside imports it.

The simulator, the thesis's experiments, the demo, and methods of the literature for comparison.
"""
