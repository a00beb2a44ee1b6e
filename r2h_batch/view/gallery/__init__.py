"""Pictures of a run: the report's gallery. `r2h-batch report --gallery`."""
