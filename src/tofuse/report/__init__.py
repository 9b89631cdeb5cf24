"""report.html: the run, explained to a person."""
