"""`python -m r2h_batch.runs`."""

import sys

from r2h_batch.rejudge.command import main

if __name__ == "__main__":
    sys.exit(main())
