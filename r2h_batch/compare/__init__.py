"""Methods paired on the trials that they share. `python -m r2h_batch.compare --help`."""
