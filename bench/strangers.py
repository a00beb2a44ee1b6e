"""Attacks by somebody who had read the pages and none of the code: docs/results/attacks.md, second table.

    python bench/strangers.py [--only WORD ...]

Each attack writes its files into a folder and gives the command line a user would give. Command after command runs in a process
of its own. Whatever an attack is about, all of this must hold: the command ends within the limits of time and memory, no
traceback, a refusal is one line, nothing beside the working folder is written, no file beside it is told, no text of a stranger
becomes a control character, a tag, a formula, a program or a command of TeX, and no code of a file runs. `must` says
what the exit code must be, `then` what must hold besides.
"""

import json
import os
import sys
from collections.abc import Iterator, Sequence

import _strange_answers
import _strange_methods
import _strange_names
import _strange_places
import _strange_runs
import _strange_things
from _attack import Attack, attacked

LISTS = (_strange_names, _strange_answers, _strange_places, _strange_runs, _strange_things, _strange_methods)


def every() -> dict[str, dict[str, Attack]]:
    """All attacks: kind -> what -> attack."""
    return {kind: attacks for one in LISTS for kind, attacks in one.KINDS.items()}


def each_of(words: Sequence[str]) -> Iterator[tuple[str, str, Attack]]:
    """The attacks whose kind or name has one of these words; all without words."""
    for kind, attacks in every().items():
        for what, attack in attacks.items():
            if not words or any(w in f"{kind}: {what}" for w in words):
                yield kind, what, attack


def measured(words: Sequence[str] = ()) -> dict[str, dict[str, dict[str, object]]]:
    """Runs the attacks: kind -> what -> how it ended."""
    import r2h_batch.__main__
    import r2h_batch.evaluate
    import r2h_batch.sweep.command  # noqa: F401 (once, before the first fork)

    rows: dict[str, dict[str, dict[str, object]]] = {}
    for kind, what, attack in each_of(words):
        bad, ended = attacked(attack)
        rows.setdefault(kind, {})[what] = {
            "wrong": bad,
            "must": attack.must,
            "fell": attack.fell,
            **ended._replace(said=ended.said[-300:])._asdict(),
        }
        del rows[kind][what]["told"]
        last = ended.said.strip().splitlines()[-1:] or [""]
        line = f"{kind}: {what}: {ended.how} {ended.seconds:.1f} s {ended.mib} MiB {last[0][:230]!r}"
        print(f"*** {bad}: {line}" if bad else line, flush=True)
        if bad and words:
            print(ended.said[-3000:], ended.told[-2000:], flush=True)
    return rows


if __name__ == "__main__":
    os.environ.setdefault("MUJOCO_GL", "osmesa")
    found = measured([w for w in sys.argv[1:] if not w.startswith("--")])
    print(json.dumps({k: len(v) for k, v in found.items()}))
