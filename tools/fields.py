"""The tables of what a method is given: `python tools/fields.py` prints them, the site has them (`hooks` in mkdocs.yml).

They are read from the docstrings of the classes. `<!-- fields NAME -->` of docs/reference/fields.md is the place of a table.
"""

import ast
import re
import sys
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[1]
PLACE = re.compile(r"<!-- fields (\w+) -->")


class Shown(NamedTuple):
    """A class whose fields a table shows."""

    file: str
    name: str
    prefix: str
    """what stands before a field on the page"""
    more: tuple[str, ...] = ()
    """properties and functions that stand behind the fields"""
    left_out: tuple[str, ...] = ()
    """fields that only the package itself needs"""


TABLES = {
    "trials": [Shown("types.py", "Trials", "trials.", ("object_names", "splits", "benchmark"))],
    "scene": [
        Shown("scene/scene.py", "Scene", "scene.", ("palm",)),
        Shown("config.py", "Workplace", "scene.config.workplace."),
        Shown(
            "scene/robot.py",
            "Robot",
            "scene.robot.",
            ("reach_m",),
            (
                *("table_from", "visuals", "dynamics", "links", "T_parent_joint", "max_torque", "T_wrist3_flange"),
                *("T_flange_gripper", "arm", "gripper", "gripper_part", "gripper_motion", "gripper_side", "linkage"),
                *("self_pairs", "object_pairs", "digest", "ik_missed"),
            ),
        ),
    ],
    "objects": [
        Shown(
            "scene/objects.py",
            "ObjectModel",
            "scene.objects[i].",
            ("who", "occupancy", "pieces", "mesh"),
            ("piece_vertices", "piece_faces", "piece_vertex_offsets", "piece_face_offsets", "voxels"),
        )
    ],
    "hands": [
        Shown("scene/tables.py", "Hands", "scene.hands.", ("directions",)),
        Shown("scene/hand.py", "HandSet", "scene.hands.set.", (), ("hull_vertex_ids", "hull_offsets", "model")),
    ],
    "candidates": [Shown("methods/candidates.py", "CandidateTable", "candidate_table(scene).", ("rows",))],
}


def sentence(text: str) -> str:
    """The first sentence of a docstring as a cell: one line, without its full stop, code in single backticks."""
    text = re.sub(r":\w+:`(\w+)`", r"`\1`", " ".join(text.split()).replace("``", "`"))
    return re.split(r"(?<=[^.])\.(?: |$)", text)[0].replace("|", r"\|")


def kind(annotation: ast.expr) -> str:
    """A field's type as the page names it: numbers with their shape, else what it is."""
    text = ast.unparse(annotation).replace(" | None", "")
    if found := re.fullmatch(r"(\w+)\[Tensor, '(.*)'\]", text):
        sizes = ", ".join(n.lstrip("*").upper() if n.isalpha() else n for n in found[2].split())
        return f"{found[1].lower()} ({sizes}{',' if ' ' not in found[2].strip() else ''})"
    if found := re.fullmatch(r"NDArray\[np\.(\w+?)_?\]", text):
        return found[1]
    plain = {"tuple[str, ...]": "texts", "str": "text", "Array": "float64"}
    if "tuple" in text and text not in plain:
        return "numbers"
    return plain.get(text, text if text in ("float", "int") else "")


def described(shown: Shown) -> list[tuple[str, str, str]]:
    """Name, type and meaning of each field and of what stands behind them.

    Raises:
        ValueError: a field that is shown has no docstring, or a name is none of the class.
    """
    tree = ast.parse((ROOT / "r2h_batch" / shown.file).read_text(encoding="utf-8"))
    body = next(n.body for n in tree.body if isinstance(n, ast.ClassDef) and n.name == shown.name)
    first = body[0]
    assert isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant)
    listed = re.search(r"\n *Attributes:\n(.*)", str(first.value.value), re.DOTALL)
    said = dict(re.findall(r"^ {8}(\w+): ((?:.|\n {9,})+)", listed[1], re.MULTILINE)) if listed else {}
    kinds: dict[str, str] = dict.fromkeys(said, "")
    found: dict[str, tuple[str, str]] = {}
    for node, after in zip(body, [*body[1:], None], strict=True):
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            kinds[node.target.id] = kind(node.annotation)
            if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
                said[node.target.id] = str(after.value.value)
        elif isinstance(node, ast.FunctionDef) and node.name in shown.more:
            called = any(isinstance(d, ast.Name) and "property" in d.id for d in node.decorator_list)
            names = ", ".join(a.arg for a in node.args.args[1:])
            found[node.name] = ("" if called else f"({names})", ast.get_docstring(node) or "")
    if silent := [n for n in kinds if n not in said and n not in shown.left_out]:
        raise ValueError(f"{shown.file}: {shown.name}.{silent[0]} has no docstring, and the page shows it")
    if unknown := [n for n in (*shown.more, *shown.left_out) if n not in found and n not in kinds]:
        raise ValueError(f"{shown.file}: {shown.name} has no {unknown[0]}")
    rows = [(n, kinds[n], sentence(said[n])) for n in kinds if n not in shown.left_out]
    return rows + [(n + found[n][0], "", sentence(found[n][1])) for n in shown.more]


def table(name: str) -> str:
    """Markdown of a table."""
    lines = ["| name | type | meaning |", "|---|---|---|"]
    for shown in TABLES[name]:
        lines += [f"| `{shown.prefix}{n}` | {k} | {what} |".replace("|  |", "| |") for n, k, what in described(shown)]
    return "\n".join(lines)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """A page with the table of fields at each place for one."""
    return PLACE.sub(lambda found: table(found[1]), markdown)


def main() -> int:
    """The exit code."""
    for name in TABLES:
        print(f"{name}\n\n{table(name)}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
