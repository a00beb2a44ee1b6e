"""A benchmark as one file: objects, hands, grasps, thresholds, table and home. `r2h-batch benchmark
--help`."""
