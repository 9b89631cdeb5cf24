"""The result of a run: its types, the verdict, and the output folder."""
