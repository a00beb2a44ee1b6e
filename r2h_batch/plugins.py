"""Things of one kind under their names: ours, and those of a stranger's package. Standard library only.

A room makes one `Registry` for each kind, beside the things or below them:

    POLICIES: Registry[type] = Registry("policy", modules=("r2h_batch.closed_loop.policies",))

    @POLICIES("servo")                     # in closed_loop/policies.py, or in any module of `modules`
    class Servo: ...

    POLICIES["servo"]                      # imports the modules, once, when a name is first asked for
    list(POLICIES); "slow" in POLICIES       # as well; with `names` and `light` they do not

A package of ours in `modules` stands for all of its modules, so that a new file needs no line
elsewhere. A stranger's package names what it adds in its own pyproject.toml, and nothing of ours
changes:

    [project.entry-points."r2h_batch.plugins"]
    "policy.slow" = "their_package.arms:Slow"       # KIND.NAME: one thing, imported when it is used
    anything = "their_package.r2h"                  # a module that registers when it is imported

A criterion of your own, whole (`"criterion.level" = "mine:LEVEL"`, in mine.py):

    from r2h_batch.verdicts import SPLITS, CriterionEntry

    LEVEL = CriterionEntry(
        "level", "f_level", "F_level", 5, "#666666", SPLITS, True, since="mine 1.0", unit="deg", function="mine:level",
        means="30 degrees less the tilt of the closing axis", fails="the gripper is tilted")

    def level(e):                                       # e: r2h_batch.judge.metrics.Evidence, B rows
        from r2h_batch.judge.metrics import Criterion   # here: whoever reads the entry needs no torch
        tilt = e.held.T_world_ee[:, 2, 1].clamp(-1, 1).asin().rad2deg().abs()
        return Criterion(tilt, e.held.active, limit=30.0, below=True)

Its fields, in order: name, key and heading of its rate, place of the heading in tables, colour, splits, whether a margin of 0
passes (`r2h_batch.verdicts.CriterionEntry` has the others).

What is in no package is `module:function` on a command line (`base.user_code.chosen`).
"""

import difflib
import pkgutil
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Generic, TypeVar

from r2h_batch import strangers
from r2h_batch.strangers import stranger, words_of

GROUP = "r2h_batch.plugins"
"""The group of entry points in which other packages name what they add."""

SLOW_S = 3.0
"""A package whose import takes longer is named."""

T = TypeVar("T")
U = TypeVar("U")


class PluginError(ValueError):
    """A name that is unknown or taken, or a fault of another package, in one line."""


class PackageError(PluginError):
    """A fault of another package: one line that names the package and its entry point. A command ends with exit code 1."""

    exit_code = 1


class Registry(Generic[T]):
    """The things of one kind by name, in the order in which they came: ours first.

    Args:
        kind: in messages, and with _ for spaces in entry points (`KIND.NAME`).
        things: those that are light enough to be here from the start.
        modules: modules and packages of ours that register more when they are imported: when a name
            is asked for that is not here yet.
        names: names that those modules give, in the order in which lists show them.
        light: these names are all that those modules give, so lists need not import them.
        wrong: of a name and a thing of another package, what is wrong with it in words; empty where it may be used.
    """

    def __init__(
        self,
        kind: str,
        things: Mapping[str, T] | None = None,
        *,
        modules: Sequence[str] = (),
        names: Sequence[str] = (),
        light: bool = False,
        wrong: Callable[[str, Any], str] = lambda name, thing: "",
    ) -> None:
        self.kind, self._wrong = kind, wrong
        self._things: dict[str, T] = dict(things or {})
        self._modules, self._names, self._light = list(modules), tuple(names), light
        self._declared: dict[str, EntryPoint] | None = None
        self._strangers = False  # whether modules of other packages were imported

    def __call__(self, name: str) -> Callable[[U], U]:
        """A decorator: what stands below it is registered under this name."""

        def keep(thing: U) -> U:
            self.add(name, thing)  # type: ignore[arg-type]  # a class stands for what it makes
            return thing

        return keep

    def add(self, name: str, thing: T) -> None:
        """Registers a thing.

        Raises:
            PluginError: the name is another thing's, or the thing is wrong. A module that is imported anew may repeat its own.
        """
        if name not in self._things and (words := self._wrong(name, thing)):
            raise PackageError(f"{self.kind} {name!r} ({_place(thing)}): {words}")
        old, new = _place(self._things.get(name, thing)), _place(thing)
        if old != new:
            raise PluginError(
                f"two of kind {self.kind} are called {name!r}: {old} and {new}; rename one of them"
            )
        self._things[name] = thing

    def __getitem__(self, name: str) -> T:
        """The thing of this name.

        Raises:
            PluginError: there is none, or a package cannot be imported.
        """
        declared = self._declared_names()
        for bring in (
            self._import_ours,
            lambda: self._load(declared, name),
            self._import_strangers,
        ):
            if name in self._things:
                break
            bring()
        if name not in self._things:
            raise PluginError(self.unknown(name))
        return self._things[name]

    def __contains__(self, name: object) -> bool:
        return name in self._things or name in self._names or name in set(self)

    def __iter__(self) -> Iterator[str]:
        """The names. This imports our modules, unless `light`; it imports a stranger's module only where its
        entry point does not say KIND.NAME."""
        if not self._light:
            self._import_ours()
        self._import_strangers()
        return iter(dict.fromkeys((*self._names, *self._things, *self._declared_names())))

    @property
    def declared(self) -> tuple[str, ...]:
        """Names that other packages' entry points give as KIND.NAME; nothing is imported."""
        return tuple(self._declared_names())

    def known(self, name: str) -> T | None:
        """The thing of this name where it is here already; nothing is imported."""
        return self._things.get(name)

    def entry(self, name: str) -> str:
        """Whose thing this is, for messages: the entry point and its package, or where the thing stands.

        Args:
            name: of a thing that is here.
        """
        declared = self._declared_names().get(name)
        return (
            f"{self.kind} {name} of {_place(self[name])}" if declared is None else _named(declared)
        )

    def outside(self, name: str) -> str:
        """`module:name` of a function or class of somebody else's; empty for ours.

        Raises:
            PluginError: as for the thing itself.
        """
        if entry := self._declared_names().get(name):
            return entry.value
        thing = self[name]
        return "" if thing.__module__.startswith("r2h_batch.") else _place(thing)

    def unknown(self, name: str) -> str:
        """The line about a name that is not here: the nearest one, and all."""
        names = list(self)
        near = difflib.get_close_matches(name, names, n=1)
        hint = f", did you mean {near[0]}?" if near else ""
        return f"no {self.kind} is called {name!r}{hint}; there are {', '.join(names)}"

    def _import_ours(self) -> None:
        while self._modules:
            module = import_module(self._modules[0])
            for found in pkgutil.iter_modules(getattr(module, "__path__", ())):
                import_module(f"{module.__name__}.{found.name}")
            self._modules.pop(0)

    def _declared_names(self) -> dict[str, EntryPoint]:
        """Name -> entry point of a stranger's, of those that are called KIND.NAME."""
        if self._declared is None:
            found: dict[str, EntryPoint] = {}
            for entry in installed():
                of, dot, name = entry.name.partition(".")
                if of != self.kind.replace(" ", "_") or not dot:
                    continue
                if not self._light:
                    self._import_ours()
                if name in found or name in self._names or name in self._things:
                    other = _owner(found[name]) if name in found else "r2h_batch"
                    raise PackageError(
                        f"{_owner(entry)} calls a {self.kind} {name!r}, and so does {other}; rename it in its entry points or"
                        " uninstall it"
                    )
                found[name] = entry
            self._declared = found
        return self._declared

    def _load(self, declared: Mapping[str, EntryPoint], name: str) -> None:
        if name in declared:
            thing = _loaded(declared[name])
            if words := self._wrong(name, thing):
                raise PackageError(f"{_named(declared[name])}: {words}")
            self.add(name, thing)

    def _import_strangers(self) -> None:
        """Imports the modules of other packages that register what they add."""
        if self._strangers:
            return
        self._strangers = True  # such a module may ask for names itself
        try:
            for entry in installed():
                if "." not in entry.name:
                    _loaded(entry)
        except BaseException:
            self._strangers = False
            raise


@lru_cache(maxsize=1)
def installed() -> tuple[EntryPoint, ...]:
    """The entry points of other packages, all kinds together; nothing is imported."""
    return tuple(entry_points(group=GROUP))


def _loaded(entry: EntryPoint) -> Any:
    try:
        with _told_if_slow(_named(entry)), stranger(_named(entry), entry.module):
            return entry.load()
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # SystemExit too: the stranger's code runs
        what = str(error) if isinstance(error, PluginError) else words_of(error)
        raise PackageError(
            f"{_named(entry)} cannot be imported ({what}); mend the package or uninstall it"
        ) from error


@contextmanager
def _told_if_slow(name: str) -> Iterator[None]:
    done = threading.Event()

    def speak() -> None:
        seconds = 0.0
        while not done.wait(SLOW_S):
            seconds += SLOW_S
            strangers.say(f"importing {name}: {seconds:.0f} s so far")

    threading.Thread(target=speak, name="import of another package", daemon=True).start()
    try:
        yield
    finally:
        done.set()


def _named(entry: EntryPoint) -> str:
    return f"{entry.name} = {entry.value} of {_owner(entry)}"


def _owner(entry: EntryPoint) -> str:
    return f"package {entry.dist.name}" if entry.dist else entry.value


def _place(thing: Any) -> str:
    """`module:name` of a function or class; of anything else its text."""
    name = getattr(thing, "__qualname__", None)
    return f"{thing.__module__}:{name}" if name else repr(thing)[:80]
