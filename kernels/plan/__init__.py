"""Paths: postures, edges, search."""
