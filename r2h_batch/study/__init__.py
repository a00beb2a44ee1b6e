"""Simulation against people: the kit of the user study. `python -m r2h_batch.study --help`."""
