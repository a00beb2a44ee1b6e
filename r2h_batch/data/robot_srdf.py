"""An SRDF beside a robot's URDF: pairs of links that it does not check, postures that it names.

Its pairs are compared with those that are measured here, not trusted: a tool may have written them for
other collision bodies.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.read import printable
from r2h_batch.data.robot_chain import Chain
from r2h_batch.data.robot_model import parsed

MAX_PAIRS = 65536


@dataclass(frozen=True)
class Srdf:
    """Content of the file that is used."""

    disabled: Mapping[frozenset[str], str]
    """two links of the URDF -> the reason that the file gives"""
    states: Mapping[str, Mapping[str, float]]
    """name of a posture -> joint -> rad"""


def read_srdf(path: Path) -> Srdf:
    """The SRDF of a stranger: bounded in size, without a document type.

    Raises:
        FileError: one line that says what the file has and what is allowed.
    """
    root, shown = parsed(path), printable(path)
    pairs = root.findall("disable_collisions")
    if root.tag != "robot" or len(pairs) > MAX_PAIRS:
        raise FileError(f"{shown}: an SRDF has <robot>, and at most {MAX_PAIRS} pairs of links")
    disabled = {}
    for pair in pairs:
        one, other = pair.get("link1"), pair.get("link2")
        if not one or not other:
            raise FileError(f"{shown}: a <disable_collisions> needs link1 and link2")
        disabled[frozenset((one, other))] = printable(pair.get("reason", "no reason"))[:40]
    states: dict[str, dict[str, float]] = {}
    for state in root.findall("group_state"):
        own = states.setdefault(str(state.get("name")), {})
        for joint in state.findall("joint"):
            try:
                own[str(joint.get("name"))] = float(joint.get("value", "").split()[0])
            except (ValueError, IndexError):
                what = f"joint {printable(joint.get('name'))[:40]} of state {printable(state.get('name'))[:40]}"
                raise FileError(f"{shown}: {what} has no value in rad") from None
    return Srdf(disabled, states)


def home_of(srdf: Srdf | None, name: str, joints: Sequence[str]) -> tuple[float, ...]:
    """The posture of the arm that a state of the SRDF is.

    Raises:
        FileError: there is none of this name, or it leaves joints out.
    """
    states = {} if srdf is None else srdf.states
    whole = {k: v for k, v in states.items() if all(j in v for j in joints)}
    if name not in whole:
        known = ", ".join(printable(k)[:40] for k in list(whole)[:12]) or "none"
        raise FileError(
            f"--home {printable(name)[:60]}: no state of the SRDF that has all joints; those are: {known}"
        )
    return tuple(whole[name][j] for j in joints)


def compared(
    srdf: Srdf,
    chain: Chain,
    links: Sequence[str],
    pairs: Mapping[tuple[str, str], tuple[bool, str]],
) -> dict[str, dict[str, str]]:
    """Where the SRDF and the pairs that were measured differ.

    Args:
        srdf: the file.
        chain: the arm as the URDF has it.
        links: names of its parts and of the gripper.
        pairs: two of them -> whether they are checked, and why.

    Returns:
        `off_but_checked`, `on_but_not_checked`: the pair -> what both say of it.
    """
    part_of = dict.fromkeys(chain.beyond, links[-1])
    for part, name in zip(chain.links, links, strict=False):
        part_of |= dict.fromkeys(part.members, name)
    off: dict[frozenset[str], str] = {}
    for pair, reason in srdf.disabled.items():
        parts = frozenset(part_of[link] for link in pair if link in part_of)
        if len(parts) == 2:
            off[parts] = reason
    found: dict[str, dict[str, str]] = {"off_but_checked": {}, "on_but_not_checked": {}}
    for one, other in combinations(links, 2):
        checked, why = pairs[one, other]
        says = off.get(frozenset((one, other)))
        if checked and says is not None:
            found["off_but_checked"][f"{one} - {other}"] = f"{why}; the SRDF: {says}"
        elif not checked and says is None:
            found["on_but_not_checked"][f"{one} - {other}"] = why
    return found
