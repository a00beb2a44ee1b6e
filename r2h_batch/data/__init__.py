"""Other people's data, one file per source. Nothing imports it but its command, the reading of a
benchmark, and `sweep --trials-from`."""
