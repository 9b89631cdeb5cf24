"""The engine: arrays in; poses, model and accuracy out.

It knows no file format, no output folder and no terminal. Its rooms are folders, each entered by
its face (`__init__`); they are listed, in the order of their imports, in ARCHITECTURE.md.
"""
