"""Fields of a stranger's file replaced by something odd."""

import copy

from r2h_batch.base.errors import FileError

ODD = [
    None, "", [], {}, -1, True, 1e308, -1e308, float("nan"), float("inf"), 10**400, 2**63, -(2**63), 1e-320,
    "x" * 100_000, "\x1b[2J\n", [[]], [None], [[1, 2], [3]], {"a": 1}, [0] * 50_000, [[0, 0, 0]] * 50_000,
]  # fmt: skip


def places(value, at=()):
    """Paths to all fields, and to the first entries of lists."""
    yield at
    items = value.items() if isinstance(value, dict) else enumerate(value[:3]) if isinstance(value, list) else ()
    for key, inner in items:
        yield from places(inner, (*at, key))


def with_odd(value, rng):
    """A copy with one or two fields that are something else."""
    changed = copy.deepcopy(value)
    for _ in range(rng.choice([1, 1, 2])):
        *way, last = rng.choice([p for p in places(changed) if p])
        at = changed
        for key in way:
            at = at[key]
        at[last] = copy.deepcopy(rng.choice(ODD))
    return changed


def outcome(read):
    """Whether the file was read; a refusal is one line of plain text."""
    try:
        read()
    except FileError as error:
        words = str(error)
        assert "\n" not in words and "\x1b" not in words and len(words) < 600, words
        return False
    return True
