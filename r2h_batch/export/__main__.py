"""`python -m r2h_batch.export`: the same as `r2h-batch export`."""

import sys

from r2h_batch.export.command import export_main

if __name__ == "__main__":
    sys.exit(export_main(prog="python -m r2h_batch.export"))
