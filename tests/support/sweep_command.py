"""The sweep as a command, in a bare environment or with a home for the kernel cache."""

import os
import subprocess
import sys

PLAIN = {k: v for k, v in os.environ.items() if k not in ("HOME", "TERM", "LANG", "LC_ALL")} | {
    "LANG": "C",
    "TERM": "dumb",
}


WITH_HOME = {**os.environ, "LANG": "C", "TERM": "dumb"}  # a home for the kernel cache


def command(*arguments, env=PLAIN):
    line = [sys.executable, "-m", "r2h_batch.sweep", *map(str, arguments)]
    return subprocess.run(line, capture_output=True, text=True, env=env, timeout=900, check=False)
