"""Which parts of `make test-all` does a change touch? Prints what pytest takes after -m; nothing if it touches none.

python tools/touched.py [COMMIT]     (default: where this branch left origin/main; on main itself the commit before)

`tests/touched.tsv` says which parts read which folders. Files that are changed and not committed count as well.
"""

import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TABLE = ROOT / "tests" / "touched.tsv"


def table() -> list[tuple[str, list[str]]]:
    """(beginning of a path, names of the parts) of each line but the head."""
    lines = (line.split("\t") for line in TABLE.read_text("utf-8").splitlines()[1:])
    return [(place, parts.split()) for place, parts in lines]


def parts_of(changed: Iterable[str]) -> list[str]:
    """Names of the parts that read one of these files."""
    rows, changed = table(), tuple(changed)
    return sorted({p for place, parts in rows for p in parts if any(name.startswith(place) for name in changed)})


def expression(parts: Iterable[str]) -> str:
    """What pytest takes after -m."""
    return " or ".join(f"whole(part='{part}')" for part in parts)


def _git(*words: str) -> str:
    """What git says; "" where it cannot."""
    done = subprocess.run(["git", "-C", str(ROOT), *words], capture_output=True, text=True, check=False)
    return done.stdout.strip() if done.returncode == 0 else ""


def base() -> str:
    """The commit that the change is compared with; "" where git cannot tell."""
    left, here = _git("merge-base", "HEAD", "origin/main"), _git("rev-parse", "HEAD")
    return left if left and left != here else _git("rev-parse", "--verify", "-q", "HEAD~1")


def main() -> None:
    """Prints the expression, and on stderr what it was made of."""
    commit = sys.argv[1] if len(sys.argv) > 1 else base()
    if not commit:
        print("no earlier commit here: nobody can tell what changed; `make test-all` runs everything", file=sys.stderr)
        return
    parts = parts_of(_git("diff", "--name-only", commit).splitlines())
    print(f"parts of test-all that changes since {commit[:12]} touch: {' '.join(parts) or 'none'}", file=sys.stderr)
    print(expression(parts))


if __name__ == "__main__":
    main()
