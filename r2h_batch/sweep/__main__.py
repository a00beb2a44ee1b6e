"""`python -m r2h_batch.sweep`."""

import sys

from r2h_batch.sweep.command import main

if __name__ == "__main__":
    sys.exit(main())
