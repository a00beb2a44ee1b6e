"""`python -m r2h_batch.compare`."""

import sys

from r2h_batch.compare.command import main

if __name__ == "__main__":
    sys.exit(main())
