"""Rigid motions and cameras: the frames that everything else is expressed in."""
