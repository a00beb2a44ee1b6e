"""Labelled pairs of new instances, from which methods learn."""
