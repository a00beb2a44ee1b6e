"""Joins the two towers: trials, methods, verdicts, stored rows. `python -m r2h_batch.sweep
--help`."""
