"""Objects of the command line's `families:CATEGORY,... x COUNT seed SEED`: instances that nobody has seen."""

import re
from collections.abc import Sequence
from functools import lru_cache

from r2h_batch.base.errors import FileError, nearest
from r2h_batch.base.io.read import printable
from r2h_batch.scene.objects import OBJECT_NAMES, ObjectModel
from r2h_batch.scene.vocabulary import THINGS

PREFIX = "families:"
MOST = 1000
"""Instances of one command, a CPU second each."""
FIRST_SERIES = 1000
"""Series of seed 0; smaller ones are shipped or learned from."""
FORM = re.compile(
    r"families:(?P<names>[a-z_,* ]*?)\s*(?:x\s*(?P<count>\d+))?\s*(?:seed\s*(?P<seed>\d+))?\s*"
)
HOW = (
    'write families:CATEGORY,... x COUNT seed SEED, as in --objects "families:cup,hammer x 20 seed 7"; '
    f"CATEGORY is * or of {', '.join(OBJECT_NAMES)}"
)


def family_objects(text: str) -> tuple[ObjectModel, ...]:
    """The instances that such a text names, category by category.

    Args:
        text: `families:cup,hammer x 20 seed 7`; `families:*` means all categories; without a count 6 of
            each, without a seed 0.

    Raises:
        FileError: not of this form, an unknown category, more than `MOST` instances, or no manifold3d.
    """
    categories, count, seed = _asked(text)
    return _drawn(categories, count, seed)


def family_splits(text: str) -> set[str]:
    """The splits of the categories that such a text names; nothing is drawn."""
    from r2h_batch.scene.objects import S0_NAMES

    return {"S0" if c in S0_NAMES else "S1" for c in _asked(text)[0]}


def _asked(text: str) -> tuple[tuple[str, ...], int, int]:
    found = FORM.fullmatch(text)
    if found is None:
        raise FileError(f"--objects {printable(text)[:200]!r}: {HOW}")
    names: Sequence[str] = [n.strip() for n in found["names"].split(",")]
    names = OBJECT_NAMES if names == ["*"] else names
    if unknown := [printable(n)[:40] for n in names if n not in OBJECT_NAMES]:
        same = [c for c in OBJECT_NAMES if unknown[0].replace("_", " ") in THINGS[c].names]
        hint = f", did you mean {same[0]}?" if same else nearest(unknown[0], OBJECT_NAMES)
        raise FileError(
            f"--objects: no family is called {unknown[0]!r}{hint}; there are {', '.join(OBJECT_NAMES)}, or * for all"
        )
    if len(set(names)) < len(names):
        raise FileError("--objects: a family stands twice; give each once")
    count, seed = (
        int((found[word] or usual)[:20]) for word, usual in (("count", "6"), ("seed", "0"))
    )
    families = f"{len(names)} families" if len(names) > 1 else "one family"
    if not 1 <= count <= MOST // len(names):
        each, whole = f"x {count:,} of {families}", f"{count * len(names):,}"
        allowed = f"at most {MOST:,} are allowed, so write x 1 to x {MOST // len(names)}"
        raise FileError(f"--objects: {each} is {whole} objects; {allowed}")
    if seed >= 1 << 31:
        raise FileError(f"--objects: the seed is {seed}; it must be below 2^31")
    return tuple(names), count, seed


@lru_cache(maxsize=4)
def _drawn(categories: tuple[str, ...], count: int, seed: int) -> tuple[ObjectModel, ...]:
    try:
        from r2h_batch.scene.families.draw import draw_instance, model_of
    except ModuleNotFoundError as error:
        raise FileError(
            f"--objects families: needs {error.name}; pip install 'r2h_batch[build]'"
        ) from None
    jobs = [(c, i) for c in categories for i in range(count)]
    return tuple(model_of(draw_instance(c, FIRST_SERIES + seed, i)) for c, i in jobs)
