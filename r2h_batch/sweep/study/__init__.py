"""Simulation against people: the kit of the user study."""
