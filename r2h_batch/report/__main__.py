"""`python -m r2h_batch.report`."""

import sys

from r2h_batch.report.command import main

if __name__ == "__main__":
    sys.exit(main())
