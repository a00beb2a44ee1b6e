"""`python -m r2h_batch.scene`."""

import sys

from r2h_batch.export.command import scene_main

if __name__ == "__main__":
    sys.exit(scene_main())
