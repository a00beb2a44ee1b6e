"""Settings of the configuration on a command line. Their names and types are those of `EvalConfig`'s fields:
`--plan.edge-check moveit`, and in a file `plan.edge_check: moveit`. Errors have a word of their own."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import is_dataclass, replace
from functools import cache, reduce
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

from r2h_batch.base.errors import UsageError, nearest
from r2h_batch.config import MADE_BY, OBJECT_ERRORS, EvalConfig, ExecutionError, ObjectErrors

ELSEWHERE = {
    "thresholds": "the benchmark has them; write thresholds into a benchmark.yaml",
    "workplace": "the benchmark has it; write home and table into a benchmark.yaml",
    "receiver": "say --receiver",
    "estimate.factor": "say --predictor-noise",
    "estimate.seed": "say --seed",
    "execution_error.seed": "say --seed",
    "execution_error": "say --execution-error, such as camera:5mm,1deg",
    "object_errors.translation_m": "say --object-errors, such as 5mm,4deg",
    "object_errors.rotation_deg": "say --object-errors, such as 5mm,4deg",
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
        arguments: what it read from.
    """
    typed = {a.partition("=")[0].replace("_", "-") for a in arguments}
    names = [name for name in settings() if flag_of(name) in typed]
    values = {name: getattr(line, name.replace(".", "__")) for name in names}
    return {k: v for k, v in values.items() if v != UNSAID}


def value_of(config: EvalConfig, name: str) -> Any:
    """A setting's value."""
    return reduce(getattr, name.split("."), config)


def given_in_file(data: dict[str, Any]) -> dict[str, Any]:
    """Take the settings out of the fields of a file.

    Raises:
        UsageError: one line about a section of settings, which a file says one by one.
    """
    sections = {name.partition(".")[0] for name in get_type_hints(EvalConfig)}
    for name, value in data.items():
        if name in sections and isinstance(value, dict):
            field = f"{name}.{next(iter(value), 'FIELD')}"
            raise UsageError(f"{name} is a section; write its fields on their own, as {field}: ...")
    found = {name: data.pop(name) for name in list(data) if name in settings()}
    return {k: tuple(v) if isinstance(v, list) else v for k, v in found.items() if v != UNSAID}


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


def execution_error(text: str) -> ExecutionError:
    """The errors that `--execution-error` says: `5mm,1deg` of camera and object; or of one of them (`camera:`, `object:`,
    `bias:` for a camera that errs alike in all trials); several with `+` between them.

    Raises:
        UsageError: it is of another form, says one of them twice, or an angle is above 180 degrees.
    """
    allowed = "5mm,1deg or camera:5mm,1deg, object:5mm,1deg, bias:5mm,1deg, or two of these with + between them"
    refused = f"--execution-error is {text!r}; it must be such as {allowed}"
    camera, held = None, None
    drawn: Literal["run", "trial"] = "trial"
    for word in text.split("+"):
        found = re.fullmatch(rf"(?:(camera|object|bias):)?{_NUMBER}mm,{_NUMBER}deg", word, re.ASCII)
        if not found:
            raise UsageError(refused)
        part, size = found[1], (float(found[2]) / 1000, float(found[3]))
        if (part != "object" and camera) or (part in (None, "object") and held):
            raise UsageError(refused)
        if part != "object":
            camera, drawn = size, "run" if part == "bias" else "trial"
        if part in (None, "object"):
            held = size
    try:
        return ExecutionError(*(camera or (0.0, 0.0)), drawn, *(held or (0.0, 0.0)))
    except ValueError as error:
        raise UsageError(f"--execution-error: {error}") from None


def object_error_size(text: str) -> tuple[float, float]:
    """Metres and degrees that `--object-errors` says: a level of `OBJECT_ERRORS`, or such as `5mm,4deg`. Gross errors are
    settings of their own.

    Raises:
        UsageError: it is of another form, or an angle is above 180 degrees.
    """
    found = re.fullmatch(rf"{_NUMBER}mm,{_NUMBER}deg", text, re.ASCII)
    if not found and text not in OBJECT_ERRORS:
        allowed = f"allowed are {', '.join(OBJECT_ERRORS)}, or such as 5mm,4deg"
        raise UsageError(
            f"--object-errors is {text!r}{nearest(text, list(OBJECT_ERRORS))}; {allowed}"
        )
    size = (float(found[1]) / 1000, float(found[2])) if found else OBJECT_ERRORS[text]
    try:
        ObjectErrors(*size)
    except ValueError as refused:
        raise UsageError(f"--object-errors: {refused}") from None
    return size


_NUMBER = r"(\d+\.?\d*|\.\d+)"


# ---- help


def described() -> list[tuple[str, str]]:
    """(Flag with its values, meaning and defaults) of each setting. The meaning is that of the docstrings of
    `config`."""
    rows = []
    for name, kind in settings().items():
        section, _, key = name.rpartition(".")
        owner: Any = get_type_hints(EvalConfig)[section] if section else EvalConfig
        words = _attributes(owner).get(key, "").rstrip(".")
        rows.append((f"{flag_of(name)} {_values(kind)}", f"{words} ({_defaults(name)})"))
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
