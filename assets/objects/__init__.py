"""Data of the objects and its build script."""
