"""Functions of users: how `--method` and `--predictor` find them, and which files decide what they
answer."""

import ast
import hashlib
import importlib.util
import os
import sys
import sysconfig
import traceback
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from importlib.machinery import PathFinder
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

from r2h_batch.base.errors import FileError, nearest
from r2h_batch.base.io.read import printable
from r2h_batch.plugins import PackageError, PluginError, Registry
from r2h_batch.strangers import __file__ as _GUARD
from r2h_batch.strangers import stranger

HOW = "package.module:function or FILE.py:function"
MOST_BYTES = 16 << 20
"""Largest program that is imported: Python reads a file as a whole."""

_NOTHING = object()

_BROUGHT: dict[str, Collection[str]] = {}
"""Module -> the modules that its first import brought."""


@dataclass(frozen=True)
class UserFunction:
    """A function of a user's module.

    `spec`: `module:function`, or `file.py:function` without the file's folder.
    """

    function: Callable[..., Any]
    module: ModuleType
    spec: str

    def files(self) -> dict[str, Path]:
        """Name -> file of each module that the function needs, as `user_files`: the user's, and those of its own package
        where that is installed."""
        name = self.module.__name__
        of_function = getattr(self.function, "__module__", None) or name
        own = name.partition(".")[0]
        return user_files([name, of_function, *_BROUGHT.get(name, ())], installed={own})


def load_function(spec: str, kind: str = "function") -> UserFunction:
    """The function that a text names.

    `package.module:function` is found as `python -m` finds it: in the current folder first. The
    modules beside FILE.py are found as `python FILE.py` finds them.

    Args:
        spec: `package.module:function` or `FILE.py:function`.
        kind: what messages call it, function or Class.

    Raises:
        ImportError: the module, file or function does not exist, two folders have modules of one
            name, or the module raises something while it is imported: one line that says what.
    """
    place, _, name = spec.rpartition(":")
    before = sys.modules.copy()
    try:
        with stranger(spec) as code:
            if place.endswith(".py"):
                module, spec = _import_file(Path(place)), f"{Path(place).name}:{name}"
            elif all(part.isidentifier() for part in place.split(".")):
                if not sys.flags.safe_path:
                    _search_first(Path.cwd())
                module = importlib.import_module(place)
            else:
                raise ImportError(
                    f"{place!r} is neither a name of a module nor a file that ends with .py"
                )
            code.of = module.__name__
            # a module may have a function of its own that answers
            function: Any = getattr(module, name, _NOTHING)
            near = nearest(name, _callables(module)) if function is _NOTHING else ""
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # SystemExit too: it would end the command without a word
        # one of ours, or of the module that was asked for; what that one imports in vain is told with its line
        ours = isinstance(error, ImportError) and error.name in (None, *_with_parents(place))
        if ours:
            raise
        raise ImportError(raised(error)) from error
    _BROUGHT.setdefault(module.__name__, sys.modules.keys() - before.keys())
    if function is _NOTHING:
        raise ImportError(f"{place} has no {kind.lower()} {name!r}{near}")
    return UserFunction(function, module, spec)


def _with_parents(module: str) -> Iterator[str]:
    """`a.b.c`, `a.b`, `a`."""
    while module:
        yield module
        module = module.rpartition(".")[0]


def _callables(module: ModuleType) -> list[str]:
    """Names of a module's functions and classes, its imports among them."""
    return [
        name
        for name, value in vars(module).items()
        if isinstance(name, str) and issubclass(type(value), FunctionType | type)
    ]


def text_of(error: BaseException) -> str:
    """The text of an error that a user's code raised: its `__str__` is the user's code too, and may raise.

    Args:
        error: as it was caught.
    """
    try:
        return str(error)
    except Exception:
        return "an error whose text cannot be had"


def raised(error: BaseException) -> str:
    """The error that a user's code raised, and where, in one line: the last line of a file of the user's own, where there is
    one, and not that of the library that it called.

    Args:
        error: as it was caught.
    """
    what = f"{type(error).__name__}: {printable(' '.join(text_of(error).split()))[:300]}"
    if isinstance(error, SyntaxError):  # its text says where
        return what
    frames = traceback.extract_tb(error.__traceback__)
    others = [f for f in frames if f.filename != _GUARD] or list(frames)
    where = next((f for f in reversed(others) if _is_users(f.filename)), others[-1])
    return f"{what} ({printable(where.filename)}, line {where.lineno})"


def _is_users(file: str) -> bool:
    """Whether a file belongs to no library: not to Python, not to an installed package, not to this one."""
    path = Path(file)
    if not path.is_file() or {"site-packages", "dist-packages"} & set(path.parts):
        return False
    library = [str(Path(_GUARD).parent), *map(sysconfig.get_path, ("stdlib", "platstdlib"))]
    return not any(map(path.absolute().is_relative_to, library))


def chosen(
    registry: Registry[Any], spec: str, kind: str = "function"
) -> tuple[Any, UserFunction | None]:
    """A thing that a command line names: ours, and None; or somebody else's, and where it is from.

    Args:
        registry: of its kind.
        spec: a name, ours or of an installed package (`r2h_batch.plugins`), or as `load_function` takes it.
        kind: as of `load_function`.

    Raises:
        ImportError: one line: no such name, module, file or function.
    """
    try:
        place = spec if ":" in spec else registry.outside(spec)
        if not place:
            return registry[spec], None
        if ":" not in spec:
            registry[spec]  # its package is named where it cannot be had
    except PackageError:
        raise
    except PluginError as error:
        raise ImportError(f"{error}; your own is {HOW.replace('function', kind)}") from None
    found = load_function(place, kind)
    return found.function, found


def _search_first(folder: Path) -> None:
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))


def _import_file(file: Path) -> ModuleType:
    """The file as a module: by its own name, or with a digest of its path if that name is taken."""
    try:
        file = file.resolve()
        there = file.is_file()
    except (OSError, RuntimeError):  # Python 3.11 and 3.12 raise the latter
        raise ImportError(f"{file}: a link that leads to itself") from None
    if not there:
        raise ImportError(f"{file}: no such file")
    if (size := file.stat().st_size) > MOST_BYTES:
        raise ImportError(f"{file}: {size} bytes; at most {MOST_BYTES} are allowed for a program")
    taken = getattr(sys.modules[file.stem], "__file__", None) if file.stem in sys.modules else file
    digest = hashlib.sha256(str(file).encode()).hexdigest()[:8]
    name = file.stem if taken and Path(taken) == file else f"{file.stem}_{digest}"
    if name in sys.modules:
        return sys.modules[name]
    _search_first(file.parent)
    for imported in set(_imported(name, file)):
        candidates = [file.parent / f"{imported}.py", file.parent / imported / "__init__.py"]
        loaded = getattr(sys.modules.get(imported), "__file__", None)
        own = any(p.is_file() for p in candidates)
        if loaded and own and Path(loaded).resolve() not in candidates:
            what = f"{file.name} imports {imported}, and {loaded} is loaded under that name"
            how = "rename one of them, or score the two in sweeps of their own"
            raise ImportError(f"{what}; {how}")
    found = importlib.util.spec_from_file_location(name, file)
    assert found is not None and found.loader is not None
    module = sys.modules[name] = importlib.util.module_from_spec(found)
    try:
        found.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


def user_files(modules: Iterable[str], *, installed: Collection[str] = ()) -> dict[str, Path]:
    """Name -> file of the user's modules among these and of those that they import (`module_files`), and of the files that
    they read: `METHOD_FILES` of a module, a sequence of paths from its folder, names them, or folders of them.

    Args:
        modules: dotted names.
        installed: packages in site-packages that count as the user's too.

    Raises:
        FileError: a file of `METHOD_FILES` is not there.
    """
    found = module_files(modules, installed=installed)
    for name, file in list(found.items()):
        named = getattr(sys.modules.get(name), "METHOD_FILES", ())
        if not isinstance(named, (list, tuple)) or not all(
            isinstance(f, (str, Path)) for f in named
        ):
            raise FileError(
                f"METHOD_FILES of {file} is {printable(repr(named))[:100]}; write a list of paths, such as ['weights.pt']"
            )
        for listed in named:
            path = file.parent / os.path.expanduser(listed)
            inside = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
            if not all(p.exists() for p in inside):
                raise FileError(f"{path}: no such file; METHOD_FILES of {file} names it")
            found |= {os.path.relpath(p, file.parent): p for p in inside}
    return dict(sorted(found.items()))


def module_files(modules: Iterable[str], *, installed: Collection[str] = ()) -> dict[str, Path]:
    """Name -> file of the user's modules among these and of those that they import, in functions too.

    The user's are those outside site-packages, the standard library and this package. Nothing is imported or run: names
    of `import` statements are looked up.

    Args:
        modules: dotted names.
        installed: packages in site-packages that count as the user's too.
    """
    left, found = list(modules), {}
    while left:
        name = left.pop()
        if name in found or (file := _module_file(name, installed)) is None:
            continue
        found[name] = file
        if file.suffix == ".py":
            left += _imported(name, file)
    return dict(sorted(found.items()))


def _module_file(name: str, also: Collection[str] = ()) -> Path | None:
    """The file of a user's module; None for other modules and for those without a file. `also`: as `installed` of
    `user_files`."""
    if name.partition(".")[0] == "r2h_batch":
        return None
    if (module := sys.modules.get(name)) is not None:
        file = getattr(module, "__file__", None)
    else:  # imported in a function, so far not
        file, path = None, None
        for end in [i for i, c in enumerate(f"{name}.") if c == "."]:
            try:  # whoever is installed as editable may be known to a finder of its own
                ours = path is None and name[:end] in also
                spec = (
                    importlib.util.find_spec(name[:end])
                    if ours
                    else PathFinder.find_spec(name[:end], path)
                )
            except (ImportError, ValueError):
                spec = None
            if spec is None:
                return None
            file, path = spec.origin, spec.submodule_search_locations
    if not file or not os.path.isfile(file):
        return None
    found = Path(os.path.abspath(file))
    if {"site-packages", "dist-packages"} & set(found.parts):
        return found if name.partition(".")[0] in also else None
    library = [sysconfig.get_path(k) for k in ("stdlib", "platstdlib")]
    return None if any(map(found.is_relative_to, library)) else found


def _imported(name: str, file: Path) -> Iterator[str]:
    """Names that the `import` statements of a module may mean, with the packages they lie in."""
    try:
        tree = ast.parse(file.read_bytes())
    except (OSError, SyntaxError, ValueError):
        return
    package = name if file.name == "__init__.py" else name.rpartition(".")[0]
    for node in ast.walk(tree):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            try:
                base = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
            except ImportError:  # beyond the topmost package
                continue
            names = [base, *(f"{base}.{alias.name}" for alias in node.names)]
        for full in names:
            yield from (full[:i] for i, c in enumerate(f"{full}.") if c == ".")
