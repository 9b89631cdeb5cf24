"""Applications: the command line and what it calls, from runs and reports to rigs and batches."""
