"""`python -m r2h_batch.importers`: the same as `r2h-batch import`."""

import sys

from r2h_batch.importers.command import main

if __name__ == "__main__":
    sys.exit(main(prog="python -m r2h_batch.importers"))
