"""`python -m r2h_batch.benchmark`."""

import sys

from r2h_batch.benchmark.command import main

if __name__ == "__main__":
    sys.exit(main(prog="python -m r2h_batch.benchmark"))
