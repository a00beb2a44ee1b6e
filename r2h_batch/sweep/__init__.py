"""Commands that make and read runs: sweep, results, studies.

A sweep joins trials, methods, the evaluator and the run folder. `python -m r2h_batch.sweep --help`."""
