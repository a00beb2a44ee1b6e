"""Families of objects: each category as a generator of instances, drawn by counters."""
