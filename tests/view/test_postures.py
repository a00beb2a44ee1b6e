"""Postures at a target that no path leads to: headline, picture and margin speak about one posture and one pair."""

from dataclasses import replace
from html import escape
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from rounds import each

from r2h_batch import Evaluator, load_benchmark
from r2h_batch.methods import fc
from r2h_batch.scene.person import heads_of
from r2h_batch.sweep import command as sweep
from r2h_batch.trials.predictions import write_predictions
from r2h_batch.view.captions import PAIRS, as_html, as_markdown, verdict_of
from r2h_batch.view.drawing import Drawing
from r2h_batch.view.stored import Reader
from r2h_batch.view.why import explanation

ROWS = Path(__file__).resolve().parents[2] / "bench" / "rows" / "v1-release-preset"
SOME = (
    "bowl_00",
    "cup_00",
    "wineglass_01",
    "headphones_02",
    "hammer_00",
    "bottle_01",
    "power_drill_02",
    "screwdriver_03",
)
"""Objects of r2h-v2: a benchmark of a file makes a scene of its own."""
MOST = 8
"""Failed plans of each method that are looked at."""
SAME_M = 2e-4
"""MuJoCo's depth of an overlap may be this much below the evaluator's bound: convex pieces against meshes."""


KEPT = [pytest.param(0.0, id="free"), pytest.param(0.1, id="10 cm", marks=pytest.mark.whole(part="view"))]


@pytest.fixture(scope="module", params=KEPT)
def at_heads(request, tmp_path_factory):
    """A run in which an object is held out 5 cm before the middle of each receiver's head, and what is to be kept from that."""
    folder = tmp_path_factory.mktemp("heads")
    file = folder / "own.yaml"
    objects = "".join(f"  - built_in: {name}\n" for name in SOME)
    file.write_text(f"protocol: r2h-v2\nhead_clearance_m: {request.param}\nobjects:\n{objects}")
    benchmark = load_benchmark(file)
    trials = benchmark.trials(8)
    answer = fc.predict(trials, Evaluator(benchmark).scene)
    head = heads_of(trials.receiver)[:, :, :3].mean(1)
    T = answer.T_world_ee.clone()
    T[:, :3, 3] = head
    T[:, :2, 3] -= 0.1 * head[:, :2] / head[:, :2].norm(dim=1, keepdim=True)
    write_predictions(folder / "heads.npz", replace(answer, T_world_ee=T, method="heads"))
    line = ["--predictions", str(folder / "heads.npz"), "--trials", "8", "--execute.sim", "none"]
    assert sweep.main([*line, "--benchmark", str(file), "--out", str(folder / "run")]) == 0
    file.unlink()  # the run folder has it
    return folder / "run", request.param


def test_who_holds_an_object_into_the_head_is_told_so_in_words_and_picture(at_heads):
    run, kept = at_heads
    reader = Reader(run)
    assert reader.run.header.get("head_clearance_m", 0.0) == kept
    told = "within 10 cm of the head" if kept else "receiver head"
    rows = [r for r in reader.rows("heads").to_pylist() if r["plan_reason"] == "ik_in_collision"]
    found = []
    for row in each(rows):
        drawing = Drawing(reader.trial(row["trial_id"], "heads"))
        if "receiver/head" not in drawing.witness.geoms:
            continue
        found.append(row["trial_id"])
        assert drawing.stored.asked.nearest.other == "head" and told in drawing.witness.caption
        why = explanation(reader.run, row["trial_id"], "heads", lambda: reader)
        assert told in why.witness and ("within 10 cm of the head" in why.why) == bool(kept)
        assert "receiver head" not in str(why) or not kept
        assert not kept or f"by {-1e3 * row['margin_plan_m']:.1f} mm or more" in why.witness
        (mark,) = [
            m for m in drawing.marks if m.group == "witness" and m.geom == drawing.model.geom("receiver/head").id
        ]
        low, high = heads_of(torch.from_numpy(drawing.stored.receiver[None]).float())[0].double().numpy()
        data, size = drawing.at(drawing.stored.target_q), drawing.model.geom_size[mark.geom]
        assert np.allclose(data.geom_xpos[mark.geom], 0.5 * (low + high)[:3], atol=1e-6)
        assert np.allclose(size[:2], [low[3] + kept, 0.5 * np.linalg.norm((high - low)[:3])], atol=1e-6)
    assert len(found) >= 4


@pytest.fixture(scope="module")
def reader():
    return Reader(ROWS)


def blocked(reader, method):
    """Trials whose postures at the target all collide."""
    rows = reader.rows(reader.method(method)).to_pylist()
    rows = [r for r in rows if (r["outcome"], r["plan_reason"]) == ("plan", "ik_in_collision")]
    return [r["trial_id"] for r in rows[:MOST]]


def depth(drawing, kind):
    """The deepest overlap of a kind of pair in the posture that is drawn, m, by MuJoCo."""
    model, data = drawing.model, drawing.at(drawing.stored.target_q)
    owner = {"hand": ("robot", "gripper", "hand"), "table": ("robot", "gripper", "table"),
             "object_hand": ("object", "object", "hand"), "object_table": ("object", "object", "table")}  # fmt: skip
    first, second, third = owner[kind]
    geoms = [(g, str(model.geom(g).name).partition("/")[0]) for g in range(model.ngeom) if model.geom_contype[g]]
    least = 0.0
    for a, x in geoms:
        for b, y in geoms:
            if x in (first, second) and y == third:
                least = min(least, mujoco.mj_geomDistance(model, data, a, b, 0.01, np.zeros(6)))
    return -least


@pytest.mark.parametrize("method", ["random", pytest.param("fc", marks=pytest.mark.slow)])
def test_headline_picture_and_caption_name_the_pair_that_the_stored_margin_is_about(reader, method):
    trials = blocked(reader, method)
    assert len(trials) >= 6
    others = 0
    for trial in trials:
        stored = reader.trial(trial, method)
        assert not stored.note  # the margin computed again is the stored one
        drawing, asked = Drawing(stored), stored.asked
        witness, margin_m = drawing.witness, stored.row["margin_plan_m"]
        assert abs(asked.clearance_m - margin_m) < 1e-6 and margin_m < 0, trial
        assert witness.kind == asked.nearest.kind, trial
        assert PAIRS[witness.kind] in verdict_of(stored) and escape(witness.caption) in as_html(drawing)
        assert [m.text for m in drawing.marks if m.text] == [witness.caption]
        # the drawn arm is at the target, and its red pair overlaps at least as deep as the margin says
        data = drawing.at(stored.target_q)
        assert np.abs(data.site("ee").xpos - stored.T_world_ee[:3, 3]).max() < 1e-4, trial
        assert -witness.distance_m > -margin_m - SAME_M, trial
        if witness.kind in ("hand", "table", "object_hand", "object_table"):
            assert depth(drawing, witness.kind) >= -margin_m - SAME_M, trial
        assert witness.kind in asked.met and sum(asked.met.values()) <= 8
        others += stored.row["plan_pair"] != witness.kind
    if method == "random":
        assert others  # the planner's check of another posture met another pair first: that is not what is shown


def test_the_panel_counts_what_the_postures_meet(reader):
    found = [reader.trial(t, "random") for t in blocked(reader, "random")[:8]]
    several = next(s for s in found if len(s.asked.met) > 1)
    n = sum(several.asked.met.values())
    words = as_markdown(Drawing(several))
    assert f"of {n} postures that reach the target" in words
    assert all(f"{PAIRS[kind]} {k}" in words for kind, k in several.asked.met.items())


def test_a_margin_of_the_hand_that_the_planner_sees_is_called_so():
    reader = Reader(ROWS.parent / "v1-paper-preset")
    stored = reader.trial(0, "random")
    assert stored.row["plan_reason"] == "ik_in_collision" and stored.asked.nearest.kind == "hand"
    assert Drawing(stored).witness.caption.endswith("for the planner, which sees the hand with an error")
