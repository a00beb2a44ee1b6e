"""Which object goes to which hand, where it stands, how it is held; the benchmark file; predictions."""
