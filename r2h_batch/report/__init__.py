"""Tables, charts, pages of a run folder. `python -m r2h_batch.report --help`."""
