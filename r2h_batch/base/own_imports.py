"""Which modules of this package others import, read from their text: nothing is imported. Regular expressions
find the statements in a sixtieth of the time that syntax trees take; a test compares both.

An import counts wherever it stands, in a function too; one below `if TYPE_CHECKING:` does not. A module that is
named in a string counts as well: `"r2h_batch.closed_loop.policies"`, a package with all its modules (as
`plugins.Registry` imports them), and `f"r2h_batch.judge.motion.sim_{engine}"` with whatever begins so.
"""

import os
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

PACKAGE = "r2h_batch"

_TYPING = re.compile(r"^if TYPE_CHECKING:[^\n]*\n(?:[ \t]+[^\n]*\n|\n)*", re.MULTILINE)
_IMPORTS = re.compile(
    r"\n[ \t]*(?:from[ \t]+([.\w]+)[ \t]+import[ \t]*(\((?:[^)#]|#[^\n]*)*\)|[^\n]+)|import[ \t]+([^\n#;]+))"
)
_NAMED = re.compile(rf"""["']({PACKAGE}\.[\w.]+)(["':{{])""")
_COMMENT = re.compile(r"#[^\n]*")


def modules_of(folders: Sequence[Path]) -> dict[str, Path]:
    """Dotted name -> file of the package's own modules; not of the scripts that build assets/.

    Args:
        folders: where they are found: the package, and the folder beside which kernels/ stands in a checkout.
    """
    found = _below(folders[0], PACKAGE)
    for folder in folders[1:]:
        found |= _below(folder / "kernels", f"{PACKAGE}.kernels")
    return found


def _below(folder: Path, name: str) -> dict[str, Path]:
    files = {}
    for path in files_below(folder, (".py",)):
        *rooms, last = path.relative_to(folder).with_suffix("").parts
        if name == PACKAGE and rooms and rooms[0] == "assets":  # in a wheel they lie inside
            continue
        files[".".join((name, *rooms, *([] if last == "__init__" else [last])))] = path
    return files


def files_below(folder: Path, kinds: Collection[str]) -> Iterator[Path]:
    """Files with one of these endings in a folder and below, also where a folder is a link.

    Args:
        folder: it may be missing.
        kinds: as ".py".
    """
    for place, _, names in os.walk(folder, followlinks=True):
        yield from (Path(place, name) for name in names if os.path.splitext(name)[1] in kinds)


def imported_by(
    roots: Iterable[str],
    files: Mapping[str, Path],
    *,
    not_followed: Collection[tuple[str, str]] = (),
) -> set[str]:
    """The modules on which the roots depend, with the packages in which they lie; the roots too.

    Args:
        roots: dotted names; a package stands for all that lies in it.
        files: dotted name -> file of every module.
        not_followed: (importing, imported) module; "*" imports for any module.

    Raises:
        ModuleNotFoundError: a root is not there.
    """
    left: list[str] = []
    for root in roots:
        if root not in files:
            raise ModuleNotFoundError(f"no module {root}", name=root)
        left += (m for m in files if m == root or m.startswith(f"{root}."))
    found: set[str] = set()
    while left:
        name = left.pop()
        if name in found or name not in files:  # a folder that is no package
            continue
        found.add(name)
        if room := name.rpartition(".")[0]:
            left.append(room)  # importing a module runs its package first
        left += (
            other
            for other in imports_of(name, files)
            if (name, other) not in not_followed and ("*", other) not in not_followed
        )
    return found


def imports_of(name: str, files: Mapping[str, Path]) -> set[str]:
    """The modules that one module imports itself.

    Args:
        name: dotted.
        files: dotted name -> file of every module.
    """
    code, _ = _code(files[name])
    found: set[str] = set()
    for base, word in _statements(code, name, files[name]):
        if word and f"{base}.{word}" in files:
            found |= {f"{base}.{word}", *_offered(f"{base}.{word}", files)}
        elif base in files:
            found |= {base, *_offered(base, files, word)}
    quoted = any(f"{quote}{PACKAGE}." in code for quote in "\"'")
    for text, end in _NAMED.findall(code) if quoted else ():
        if end == "{":
            found.update(m for m in files if m.startswith(text) and "." not in m[len(text) :])
        elif text in files:
            found |= {text, *_offered(text, files)}
            if is_package(files[text]):
                found.update(m for m in files if m.rpartition(".")[0] == text)
    return found - {name}


def is_package(file: Path) -> bool:
    """Whether a module's file is that of a package."""
    return file.name == "__init__.py"


def _code(file: Path) -> tuple[str, str]:
    """A file without its texts of several lines: what runs, and what type checkers alone read."""
    code = "\n" + '""'.join(file.read_text(encoding="utf-8").split('"""')[::2])
    if "\nif TYPE_CHECKING:" not in code:
        return code, ""
    return _TYPING.sub("", code), "".join(_TYPING.findall(code))


def _statements(code: str, name: str, file: Path) -> Iterator[tuple[str, str]]:
    """(module, name in it) of each import of ours; the name is empty where the module itself is imported."""
    for origin, names, plain in _IMPORTS.findall(code):
        base = origin.lstrip(".")
        if up := len(origin) - len(base):
            rooms = name.split(".") if is_package(file) else name.split(".")[:-1]
            base = ".".join((*rooms[: len(rooms) - up + 1], *filter(None, [base])))
        if base.partition(".")[0] == PACKAGE:
            words = _COMMENT.sub("", names).strip("() \t\n").split(",")
            yield from ((base, w.partition(" as ")[0].strip()) for w in words if w.strip())
        for word in plain.split(",") if PACKAGE in plain else ():
            yield word.partition(" as ")[0].strip(), ""


def _offered(package: str, files: Mapping[str, Path], word: str = "") -> set[str]:
    """The modules behind the names that a package offers lazily (`package.lazy_names`): of one name, or of all where the
    package itself is what was imported. What it imports for type checkers says where they are."""
    if not is_package(files[package]):
        return set()
    code, typing = _code(files[package])
    if "lazy_names(" not in code:
        return set()
    return {
        f"{base}.{name}" if f"{base}.{name}" in files else base
        for base, name in _statements(typing, package, files[package])
        if base in files and word in ("", name)
    }
