"""Which trials of a benchmark were drawn again, and an answer that solves each: made by `build_certified.py`."""
