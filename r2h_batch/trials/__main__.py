"""`python -m r2h_batch.trials`."""

import sys

from r2h_batch.export.command import trials_main

if __name__ == "__main__":
    sys.exit(trials_main())
