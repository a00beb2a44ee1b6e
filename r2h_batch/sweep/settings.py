"""Settings of the configuration on a command line. Their names and types are those of `EvalConfig`'s fields:
`--plan.edge-check moveit`, `--set plan.edge_check=moveit`, and in a file `plan: {edge_check: moveit}`."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from functools import cache, reduce
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

from r2h_batch.base.errors import UsageError, nearest
from r2h_batch.config import MADE_BY, OBJECT_ERRORS, EvalConfig, ExecutionError, ObjectErrors

SHORT = {
    "sim": "execute.sim",
    "sim_model": "execute.model",
    "edge_check": "plan.edge_check",
    "plan_hand": "plan.hand",
    "object_collision": "plan.object_collision",
    "ik": "ik.solver",
    "hand_errors": "estimate.errors",
}
"""Synonyms: short names of settings."""

ELSEWHERE = {
    "thresholds": "the benchmark has them; write thresholds into a benchmark.yaml",
    "workplace": "the benchmark has it; write home and table into a benchmark.yaml",
    "receiver": "say --receiver",
    "estimate.factor": "say --predictor-noise",
    "estimate.seed": "say --seed",
    "execution_error.seed": "say --seed",
    "object_errors.seed": "say --seed",
    "chunk": "say --chunk",
    "name": "say --preset",
}
"""Fields of `EvalConfig`, or sections of it, that other flags set -> which."""

UNSAID = "auto"
"""The value that leaves a setting as the preset has it."""


@cache
def settings() -> dict[str, Any]:
    """Name of a setting, such as `plan.edge_check` -> its type without the bounds."""
    found: dict[str, Any] = {}
    for section, kind in get_type_hints(EvalConfig).items():
        if is_dataclass(kind):
            found |= {f"{section}.{k}": v for k, v in get_type_hints(kind).items()}
        else:
            found[section] = kind
    return {k: v for k, v in found.items() if elsewhere(k) is None}


def elsewhere(name: str) -> str | None:
    """How the field of `EvalConfig` is set that no setting sets; None for a setting."""
    return ELSEWHERE.get(name) or ELSEWHERE.get(name.partition(".")[0])


def flag_of(name: str) -> str:
    """A setting or an option as a flag."""
    return f"--{name.replace('_', '-')}"


def line_fields() -> list[tuple[str, Any, Any]]:
    """The settings as fields of a dataclass that tyro reads."""
    import tyro

    made = []
    for name, kind in settings().items():
        argument = tyro.conf.arg(name=name.replace("_", "-"))
        shown = Annotated[kind, argument]  # type: ignore[valid-type]
        made.append((name.replace(".", "__"), shown, value_of(EvalConfig(), name)))
    return made


def given_in(line: Any, arguments: Sequence[str]) -> dict[str, Any]:
    """The settings that a command line gives.

    Args:
        line: what tyro read, with `line_fields`.
        arguments: what it read from, synonyms replaced.
    """
    typed = {a.partition("=")[0].replace("_", "-") for a in arguments}
    names = [name for name in settings() if flag_of(name) in typed]
    values = {name: getattr(line, name.replace(".", "__")) for name in names}
    return {k: v for k, v in values.items() if v != UNSAID}


def value_of(config: EvalConfig, name: str) -> Any:
    """A setting's value."""
    return reduce(getattr, name.split("."), config)


def given_in_file(data: dict[str, Any]) -> dict[str, Any]:
    """Take the settings out of the fields of a file: sections, dotted names, short names.

    Raises:
        UsageError: one line about a field that is no setting, or a text of errors that cannot be.
    """
    found: dict[str, Any] = {}
    sections = {name.partition(".")[0] for name in settings() if "." in name}
    for name in list(data):
        full = SHORT.get(name, name)
        if name in sections and isinstance(data[name], dict):
            for key, value in data.pop(name).items():
                found[known(f"{name}.{key}", "field")] = value
        elif name in IN_ONE_WORD and isinstance(data[name], str):
            found |= IN_ONE_WORD[name](data.pop(name))
        elif full in settings():
            found[full] = data.pop(name)
    return {k: tuple(v) if isinstance(v, list) else v for k, v in found.items() if v != UNSAID}


def known(name: str, kind: str) -> str:
    """The name of a setting, written out.

    Raises:
        UsageError: another flag sets this field, or there is none.
    """
    name = SHORT.get(name, name)
    if name in settings():
        return name
    if how := elsewhere(name):
        raise UsageError(f"{name} is no setting of its own; {how}")
    allowed = [*settings(), *SHORT]
    raise UsageError(f"unknown {kind} {name!r}{nearest(name, allowed)}; see --help-all")


def configured(config: EvalConfig, given: Mapping[str, Any]) -> EvalConfig:
    """A configuration with settings.

    Args:
        config: mostly a preset.
        given: setting -> value.

    Raises:
        UsageError: one line about the first value that cannot be.
    """
    for name, value in given.items():
        section, _, key = name.rpartition(".")
        try:
            if section:
                part = replace(getattr(config, section), **{key: value})
                config = replace(config, **{section: part})
            else:
                config = replace(config, **{key: value})
        except (TypeError, ValueError) as error:
            why = re.sub(r"^\w+\.\w+", "", str(error))
            raise UsageError(f"{flag_of(name)}{why}") from None
    return config


def error_settings(text: str) -> dict[str, Any]:
    """The settings that `--execution-error` stands for: `5mm,1deg`, `camera:5mm,1deg`, `object:5mm,1deg`,
    `bias:5mm,1deg`; empty for no errors.

    Raises:
        UsageError: it is of another form, or an angle is above 180 degrees.
    """
    number = r"(\d+\.?\d*|\.\d+)"
    found = re.fullmatch(rf"(?:(camera|object|bias):)?{number}mm,{number}deg", text, re.ASCII)
    if text and not found:
        allowed = "5mm,1deg or camera:5mm,1deg, object:5mm,1deg, bias:5mm,1deg"
        raise UsageError(f"--execution-error is {text!r}; it must be such as {allowed}")
    part, *size = (found[1], float(found[2]) / 1000, float(found[3])) if found else ("", 0.0, 0.0)
    camera = [0.0, 0.0] if part == "object" else size
    held = [0.0, 0.0] if part in ("camera", "bias") else size
    drawn: Literal["run", "trial"] = "run" if part == "bias" else "trial"
    try:
        error = ExecutionError(camera[0], camera[1], drawn, held[0], held[1])
    except ValueError as refused:
        raise UsageError(f"--execution-error: {refused}") from None
    return {
        f"execution_error.{f.name}": getattr(error, f.name)
        for f in fields(error)
        if f.name != "seed"
    }


def object_error_settings(text: str) -> dict[str, Any]:
    """The settings that `--object-errors` stands for: a level of `OBJECT_ERRORS`, or such as `5mm,4deg`. Gross errors are
    settings of their own.

    Raises:
        UsageError: it is of another form, or an angle is above 180 degrees.
    """
    number = r"(\d+\.?\d*|\.\d+)"
    found = re.fullmatch(rf"{number}mm,{number}deg", text, re.ASCII)
    if not found and text not in OBJECT_ERRORS:
        allowed = f"allowed are {', '.join(OBJECT_ERRORS)}, or such as 5mm,4deg"
        raise UsageError(
            f"--object-errors is {text!r}{nearest(text, list(OBJECT_ERRORS))}; {allowed}"
        )
    size = (float(found[1]) / 1000, float(found[2])) if found else OBJECT_ERRORS[text]
    try:
        errors = ObjectErrors(*size)
    except ValueError as refused:
        raise UsageError(f"--object-errors: {refused}") from None
    return {f"object_errors.{k}": getattr(errors, k) for k in ("translation_m", "rotation_deg")}


IN_ONE_WORD: dict[str, Callable[[str], dict[str, Any]]] = {
    "execution_error": error_settings,
    "object_errors": object_error_settings,
}
"""Synonyms for several settings of a section: its name -> what a text such as `5mm,1deg` stands for."""


# ---- help


def described() -> list[tuple[str, str]]:
    """(Flag with its values, meaning and defaults) of each setting. The meaning is that of the docstrings of
    `config`."""
    short = {full: name for name, full in SHORT.items()}
    rows = []
    for name, kind in settings().items():
        section, _, key = name.rpartition(".")
        owner: Any = get_type_hints(EvalConfig)[section] if section else EvalConfig
        words = _attributes(owner).get(key, "").rstrip(".")
        more = f"; or {flag_of(short[name])}" if name in short else ""
        rows.append((f"{flag_of(name)} {_values(kind)}", f"{words} ({_defaults(name)}){more}"))
    levels = ", ".join(
        f"{k} ({1000 * m:g} mm, {d:g} degrees)" for k, (m, d) in OBJECT_ERRORS.items() if m
    )
    rows.append(
        (
            f"{flag_of('object_errors')} TEXT",
            f"how far off methods see the object, per axis: none, {levels}, or such as 7mm,3deg; all methods, also oracle and "
            "files of poses. Gross errors: --object-errors.gross",
        )
    )
    rows.append(
        (
            f"{flag_of('execution_error')} TEXT",
            "all five execution_error settings at once. 5mm,1deg: camera and object err in every trial; camera:5mm,1deg or "
            "object:5mm,1deg: one of both errs; bias:5mm,1deg: one error of the camera for all trials",
        )
    )
    return rows


def _attributes(owner: type) -> dict[str, str]:
    """Field -> its words in the class's docstring (Google style)."""
    text = (owner.__doc__ or "").partition("Attributes:\n")[2]
    found = re.findall(r"^ {8}(\w+): (.*(?:\n {12}.*)*)", text, re.M)
    return {name: " ".join(words.split()) for name, words in found}


def _values(kind: Any) -> str:
    if get_origin(kind) is Literal:
        return "|".join(get_args(kind))
    if get_origin(kind) is tuple:
        return f"{_values(get_args(kind)[0])} ..."
    return {str: "TEXT", float: "NUMBER"}.get(kind, "INT")


def _defaults(name: str) -> str:
    """The default, and what presets have instead."""
    values = {}
    for preset, make in MADE_BY.items():
        value = value_of(make(), name)
        shown = " ".join(map(str, value)) if isinstance(value, tuple) else value
        values[preset] = f"{shown:.6g}" if isinstance(shown, float) else str(shown)
    usual = values.pop("default")
    others = [f"preset {k}: {v}" for k, v in values.items() if v != usual]
    return "; ".join([f"default: {usual}", *others])
