"""Joins the two towers: trials, methods, verdicts, stored rows, and rows judged again.
`python -m r2h_batch.sweep --help`."""
