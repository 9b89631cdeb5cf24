"""`report.html`: one file, made for a person, that shows what came out and how far to trust it."""
