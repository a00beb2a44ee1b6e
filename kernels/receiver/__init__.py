"""Closing a hand on an object."""
