"""Additions of other packages to a run (`r2h_batch.plugins`): criteria that judged it, shares that its tables count,
families and methods that it uses. run.json says of each the package, the version and a digest of its code.

A sweep goes on with the same ones alone. Without one of them a run is read as it is, less its columns.
"""

from collections.abc import Collection, Mapping, Sequence
from typing import Any

from r2h_batch.base.user_code import module_files
from r2h_batch.plugins import installed
from r2h_batch.runs.provenance import file_digest
from r2h_batch.verdicts import CRITERIA, REGISTRY

ALWAYS = ("criterion", "share")
"""Kinds that every run has to do with, once they are installed."""
COLUMNS = (*ALWAYS, "")
"""Kinds without which a column is missing; a module that registers what it adds has no kind."""

Records = dict[str, dict[str, str]]


def plugin_records(*, families: Mapping[str, str], methods: Collection[str]) -> Records:
    """KIND.NAME of an entry point (or the name of one that registers what it adds) -> package, version, module and sha256
    of that module and of what it imports of its package.

    Args:
        families: category of the objects -> module of its generator, where that is the user's; empty where it is not known.
        methods: `module:function` of the methods that are asked.
    """
    found = {
        f"family.{name}": _record(["", "", module], [module])
        for name, module in families.items()
        if module
    }
    for entry in installed():
        kind, name = _kind(entry.name)
        used = kind in (*ALWAYS, "") or (kind == "family" and name in families)
        if used or (kind == "method" and entry.value in methods):
            modules = [entry.module]
            # the equation of a criterion may stand in a module that nothing else imports
            own = (e for e in REGISTRY if kind == "criterion" and e.name == name and e.function)
            modules += [e.function.partition(":")[0] for e in own]
            of = [entry.dist.name, entry.dist.version] if entry.dist else ["", ""]
            found[entry.name] = _record([*of, entry.value], modules)
    return dict(sorted(found.items()))


def package_of_method(place: str) -> str:
    """Package and version of a method that an entry point names; empty of any other.

    Args:
        place: `module:function`.
    """
    own = (e for e in installed() if _kind(e.name)[0] == "method" and e.value == place and e.dist)
    return next((f"{e.dist.name} {e.dist.version}" for e in own if e.dist), "")


def _kind(key: str) -> tuple[str, str]:
    """Kind and name; no kind of a module that registers what it adds."""
    kind, dot, name = key.partition(".")
    return (kind, name) if dot else ("", key)


def _record(of: Sequence[str], modules: Sequence[str]) -> dict[str, str]:
    """`of`: package, version and where the thing is."""
    files = module_files(modules, installed={module.partition(".")[0] for module in modules})
    names = ("package", "version", "module")
    return {**dict(zip(names, of, strict=True)), "sha256": file_digest(files.values())}


def other_plugins(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Additions of other packages in which a stored run and a sweep that would go on with it differ, each with its package. A
    share that is new changes no stored row, and a method or family that was not asked for before neither.

    Args:
        old: run.json of the folder.
        new: that of the sweep.
    """
    a, b, found = old.get("plugins") or {}, new.get("plugins") or {}, []
    for key in sorted({**a, **b}):
        kind = _kind(key)[0]
        if a.get(key) == b.get(key):
            continue
        if key not in a and kind == "criterion":
            found.append(f"{_named(key, b[key])}, which did not judge it")
        elif key in a and key not in b and kind != "method":
            found.append(f"{_named(key, a[key])}, which is not installed")
        elif key in a and key in b:
            found.append(f"{_named(key, a[key])}, now {_instead(a[key], b[key])}")
    return found


def other_criteria(a: Mapping[str, Any], b: Mapping[str, Any]) -> list[str]:
    """Criteria of one name by which two runs were judged, and that are not the same.

    Args:
        a: run.json of one.
        b: of the other.
    """
    left, right = (header.get("plugins") or {} for header in (a, b))
    both = (key for key in left if key in right and _kind(key)[0] == "criterion")
    return [
        f"{_named(key, left[key])}, and {_instead(left[key], right[key])}"
        for key in both
        if left[key] != right[key]
    ]


def criteria_since(header: Mapping[str, Any]) -> list[str]:
    """Criteria of packages that are not as they were when a run was judged.

    Args:
        header: run.json.
    """
    now = plugin_records(families={}, methods=())
    then = header.get("plugins") or {}
    old, new = ({k: v for k, v in r.items() if _kind(k)[0] == "criterion"} for r in (then, now))
    return other_plugins({"plugins": old}, {"plugins": new})


def _instead(a: Mapping[str, str], b: Mapping[str, str]) -> str:
    """The words for what stands in the place of a record: another package or version, or else another code."""
    return _of(b) if any(a[k] != b[k] for k in ("package", "version")) else "other code"


def lacking(header: Mapping[str, Any]) -> list[str]:
    """Criteria and shares of a run whose package is not installed, each with its package.

    Args:
        header: run.json.
    """
    known = {entry.name for entry in installed()} | {f"criterion.{name}" for name in CRITERIA}
    records = header.get("plugins") or {}
    return [
        _named(key, record)
        for key, record in records.items()
        if _kind(key)[0] in COLUMNS and key not in known
    ]


def _named(key: str, record: Mapping[str, str]) -> str:
    kind, name = _kind(key)
    return f"{kind or 'module'} {name} ({_of(record)})"


def _of(record: Mapping[str, str]) -> str:
    return f"{record['package']} {record['version']}".strip() or record["module"]
