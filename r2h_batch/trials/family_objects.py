"""Objects of the command line's `families:CATEGORY,... x COUNT seed SEED`: instances that nobody has seen."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

from r2h_batch.base.errors import FileError, nearest
from r2h_batch.base.io.progress import progress
from r2h_batch.base.io.read import printable
from r2h_batch.base.user_code import load_function
from r2h_batch.plugins import PackageError, PluginError
from r2h_batch.scene.families.family import FAMILIES, Family
from r2h_batch.scene.objects import ObjectModel

PREFIX = "families:"
OBJECTS = "--objects"
"""The flag of such a text in most commands."""
MOST = 1000
"""Instances of one command, a CPU second each where the cache does not hold them."""
FIRST_SERIES = 1000
"""Series of seed 0; smaller ones are shipped or learned from."""
FORM = re.compile(
    r"families:(?P<names>(?:[a-z_,* ]|[\w./-]+:\w+)*?)\s*(?:x\s*(?P<count>\d+))?\s*(?:seed\s*(?P<seed>\d+))?\s*"
    r"(?P<fillings>standing)?\s*"
)


@dataclass(frozen=True)
class Planned:
    """An instance that a text names, drawn when somebody asks for it.

    Attributes:
        family: its generator.
        series: 1000 and the seed of the text.
        index: its number in the series.
        standing: whether fillings stand at the bottom.
    """

    family: Family
    series: int
    index: int
    standing: bool

    @property
    def name(self) -> str:
        """The object's name."""
        return f"{self.family.category}_s{self.series}_{self.index:02d}"

    def drawn(self) -> ObjectModel:
        """The object, from disk where it was drawn before; the same one as the last time, if that is not long ago."""
        return drawn_instance(self)


@lru_cache(maxsize=128)
def drawn_instance(one: Planned) -> ObjectModel:
    """`Planned.drawn`, with a memory."""
    from r2h_batch.scene.families.kept import kept_instance

    return kept_instance(one.family, one.series, one.index, standing=one.standing)


def planned_objects(text: str, given: str = OBJECTS) -> tuple[Planned, ...]:
    """The instances that `family_objects` draws for a text, in its order; none is drawn.

    Args:
        text: as of `family_objects`.
        given: what the user gave the text as, for messages; behind others than `OBJECTS` it needs no `PREFIX`.

    Raises:
        FileError: as of `family_objects`.
    """
    families, count, seed, standing = _asked(text, given)
    return tuple(
        Planned(f, FIRST_SERIES + seed, i, standing) for f in families for i in range(count)
    )


def family_objects(text: str, given: str = OBJECTS) -> tuple[ObjectModel, ...]:
    """The instances that such a text names, category by category.

    Args:
        text: `families:cup,hammer x 20 seed 7`; `families:*` means all categories; without a count 6 of
            each, without a seed 0. `package.module:NAME` or `FILE.py:NAME` is a family of the user's. With the word
            `standing` at its end fillings stand at the bottom of vessels.
        given: as of `planned_objects`.

    Raises:
        FileError: not of this form, an unknown category, or more than `MOST` instances.
    """
    return _drawn(planned_objects(text, given))


def family_splits(text: str) -> set[str]:
    """The splits of the categories that such a text names; nothing is drawn."""
    return {f.split for f in _asked(text, OBJECTS)[0]}


def code_of(text: str) -> list[str]:
    """The modules or files of the user's that such a text names, which run when it is read; none in another text."""
    found = FORM.fullmatch(text)
    names = text.removeprefix(PREFIX).split(",") if found is None else found["names"].split(",")
    return [n.strip() for n in names if ":" in n] if text.startswith(PREFIX) else []


def _asked(text: str, given: str) -> tuple[tuple[Family, ...], int, int, bool]:
    """Families, count, seed, and whether fillings stand; a message begins with what the text was given as."""
    prefix = PREFIX if given == OBJECTS else ""
    try:
        return _read(text if prefix else PREFIX + text.removeprefix(PREFIX), prefix)
    except FileError as error:
        raise FileError(f"{given}: {error}") from error


def _read(text: str, prefix: str) -> tuple[tuple[Family, ...], int, int, bool]:
    try:
        known = tuple(FAMILIES)
        found = FORM.fullmatch(text)
        if found is None:
            shown = printable(text if prefix else text.removeprefix(PREFIX))[:200]
            raise FileError(
                f"{shown!r} names no families; write {prefix}CATEGORY,... x COUNT seed SEED, as in"
                f' "{prefix}cup,hammer x 20 seed 7"; CATEGORY is * or of {", ".join(known)}, or your own package.module:NAME;'
                " with the word standing behind it fillings stand at the bottom of bottles"
            )
        names: Sequence[str] = [n.strip() for n in found["names"].split(",")]
        names = known if names == ["*"] else names
        families = tuple(_own(n) if ":" in n else _named(n, known) for n in names)
    except PackageError:
        raise
    except PluginError as error:
        raise FileError(str(error)) from None
    if len({f.category for f in families}) < len(families):
        raise FileError("a family stands twice; give each once")
    count, seed = (
        int((found[word] or usual)[:20]) for word, usual in (("count", "6"), ("seed", "0"))
    )
    of = f"{len(names)} families" if len(names) > 1 else "one family"
    if not 1 <= count <= MOST // len(names):
        each, whole = f"x {count:,} of {of}", f"{count * len(names):,}"
        allowed = f"at most {MOST:,} are allowed, so write x 1 to x {MOST // len(names)}"
        raise FileError(f"{each} is {whole} objects; {allowed}")
    if seed >= 1 << 31:
        raise FileError(f"the seed is {seed}; it must be below 2^31")
    return families, count, seed, found["fillings"] is not None


def _named(name: str, known: Sequence[str]) -> Family:
    if name in known:
        return _checked(FAMILIES[name], name)
    called = {c: FAMILIES[c].words for c in known}
    same = [c for c, words in called.items() if words and name.replace("_", " ") in words.names]
    hint = f", did you mean {same[0]}?" if same else nearest(name, known)
    raise FileError(
        f"no family is called {name!r}{hint}; there are {', '.join(known)}, or * for all"
    )


def _own(spec: str) -> Family:
    """The family that a module of the user's has under this name."""
    try:
        found: object = load_function(spec).function
    except ImportError as error:
        raise FileError(f"{spec}: {' '.join(str(error).split())}") from error
    return _checked(found, spec)


def _checked(found: object, name: str) -> Family:
    """A family under its own name."""
    if not isinstance(found, Family):
        raise FileError(
            f"{name} is a {type(found).__name__}; a family is a generator below @family(...)"
        )
    if ":" not in name and found.category != name:
        raise FileError(
            f"the family that an entry point calls {name!r} calls itself {found.category!r}; give both one name"
        )
    return found


@lru_cache(maxsize=4)
def _drawn(planned: tuple[Planned, ...]) -> tuple[ObjectModel, ...]:
    found = []
    with progress("instances (kept on disk)", len(planned), "objects") as told:
        for one in planned:
            found.append(one.drawn())
            told(1)
    return tuple(found)
