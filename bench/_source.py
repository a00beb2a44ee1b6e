"""Digests of source files without comments, docstrings and blank lines: has the code that a bench measured changed since?"""

import hashlib
import io
import tokenize
from collections.abc import Iterable
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
KINDS = (".py", ".h", ".json", ".npz", ".npy", ".safetensors")
_BEFORE = (tokenize.NEWLINE, tokenize.NL, tokenize.INDENT, tokenize.DEDENT, tokenize.ENCODING, tokenize.COMMENT)


def code_of(text: str) -> str:
    """The text of a Python file without comments, docstrings, blank lines and spaces at the ends of lines."""
    lines = text.splitlines()
    tokens = list(tokenize.generate_tokens(io.StringIO(text).readline))
    cut = [t for t in tokens if t.type == tokenize.COMMENT]
    for before, token, after in zip([None, *tokens], tokens, tokens[1:], strict=False):
        alone = before is None or before.type in _BEFORE
        if token.type == tokenize.STRING and alone and after.type in (tokenize.NEWLINE, tokenize.COMMENT):
            cut.append(token)
    for token in sorted(cut, key=lambda t: t.start, reverse=True):
        (first, left), (last, right) = token.start, token.end
        kept = lines[first - 1][:left] + lines[last - 1][right:]
        lines[first - 1 : last] = [kept] + [""] * (last - first)
    return "\n".join(line.rstrip() for line in lines if line.strip())


@cache
def _digest(path: Path, changed_ns: int, size: int) -> str:
    data = code_of(path.read_text("utf-8")).encode() if path.suffix == ".py" else path.read_bytes()
    return hashlib.sha256(data).hexdigest()[:8]


def digests(places: Iterable[str], root: Path = ROOT) -> dict[str, str]:
    """Path (from `root`) -> the first 8 digits of its sha256, for each file of these files and folders.

    Raises:
        FileNotFoundError: a place that is not there.
    """
    found = {}
    for place in places:
        at = root / place
        if not at.exists():
            raise FileNotFoundError(
                f"{place} is not in {root}; MEASURES of a bench names folders and files of the checkout"
            )
        for path in sorted(at.rglob("*")) if at.is_dir() else [at]:
            if path.suffix in KINDS and path.is_file():
                stat = path.stat()
                found[path.relative_to(root).as_posix()] = _digest(path, stat.st_mtime_ns, stat.st_size)
    return found
