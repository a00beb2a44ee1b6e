"""`python -m r2h_batch.study`."""

import sys

from r2h_batch.study.command import main

if __name__ == "__main__":
    sys.exit(main())
