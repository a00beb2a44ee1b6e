"""`python -m r2h_batch.sweep`."""

import sys

from r2h_batch.base.command_line import refuse
from r2h_batch.plugins import PluginError

if __name__ == "__main__":
    try:
        from r2h_batch.sweep.command import main
    except PluginError as error:  # criteria of packages are read with the words of verdicts
        sys.exit(refuse("sweep", error))
    sys.exit(main())
