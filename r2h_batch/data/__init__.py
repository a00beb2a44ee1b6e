"""Other people's data, one file per source. Nothing imports it but the command `import`, the reading of a
benchmark, and `sweep --trials-from`."""
