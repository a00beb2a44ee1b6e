"""Data of the hand and its build script."""
