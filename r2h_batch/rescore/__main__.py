"""`python -m r2h_batch.rescore`."""

import sys

from r2h_batch.rescore.command import main

if __name__ == "__main__":
    sys.exit(main())
