"""The part of the Python interface that uses several rooms: results with methods."""
