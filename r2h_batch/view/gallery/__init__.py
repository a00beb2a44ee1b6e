"""Pictures of a run: the report's gallery, and the paper's figures. `r2h-batch report --gallery`,
`r2h-batch figures`."""
