"""`python -m r2h_batch.report`."""

import sys

from r2h_batch.gallery.command import report_main as main

if __name__ == "__main__":
    sys.exit(main())
