"""`python -m r2h_batch.results`."""

import sys

from r2h_batch.results.command import main

if __name__ == "__main__":
    sys.exit(main())
