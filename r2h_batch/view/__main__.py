"""`python -m r2h_batch.view`."""

import sys

from r2h_batch.view.command import view_main as main

if __name__ == "__main__":
    sys.exit(main())
