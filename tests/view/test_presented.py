"""What fails Presented in words and in red: the gripper, a sharp part, or the wanted part outside of the ball."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from rounds import each

from r2h_batch import Evaluator, load_benchmark
from r2h_batch.config import PRESENTED_M, EvalConfig, ExecConfig
from r2h_batch.methods import random
from r2h_batch.types import Nearer
from r2h_batch.view.captions import as_markdown
from r2h_batch.view.drawing import RED, REGION, Drawing
from r2h_batch.view.stored import judged_again


@pytest.fixture(scope="module")
def found():
    """What the margin is about -> a drawing of a row that fails by it; and one that the benchmark of before judges."""
    plain = load_benchmark("r2h-v2")
    evaluator = Evaluator(replace(plain, asks=("presented",)), EvalConfig(execute=ExecConfig(sim="none")))
    trials = plain.trials(400).named(plain.objects)
    drawings = {}
    for seed in range(4):
        asked = random.predict(trials, evaluator.scene, seed=seed)
        scores = evaluator.score(asked.T_obj_ee, asked.T_world_ee, trials, stages="pose")
        for row in torch.nonzero(scores.failed("presented"))[:, 0].tolist():
            by = Nearer(int(scores.presented_by[row]))
            if by not in drawings:
                one = torch.tensor([row])
                stored = judged_again(evaluator, trials[one], asked[one], "random")
                if stored.moves:
                    drawings[by] = Drawing(stored), trials[one], asked[one], evaluator.scene
    return drawings


def test_every_way_to_fail_is_seen_where_it_is(found):
    assert set(found) == set(Nearer)
    for by, (drawing, trial, _, scene) in each(found.items()):
        row, witness = drawing.stored.row, drawing.witness
        assert row["outcome"] == "presented" and row["presented_by"] == by.name.lower() and witness.kind == "presented"
        palm, _, ball = (x[0].double().numpy() for x in scene.palm(trial.hand_index, trial.T_world_hand))
        first, second = witness.line
        apart = float(np.linalg.norm(second - first))
        if by == Nearer.BALL:
            assert apart == pytest.approx(-row["margin_presented_m"], abs=2e-4)
            assert np.linalg.norm(second - ball) == pytest.approx(0.10, abs=1e-4)
            assert "outside the ball" in witness.caption and "ball" in drawing.groups(fails=True)
            continue
        assert np.allclose(second, palm, atol=1e-4)
        assert witness.caption == drawing_words(by, row)
        red = [m for m in drawing.marks if m.group == "witness" and m.rgba == RED]
        if by == Nearer.GRIPPER:
            names = {drawing.model.geom(m.geom).name for m in red if m.geom >= 0}
            assert names == set(witness.geoms) and all(n.startswith("gripper/") for n in names)
        else:
            assert any(m.geom < 0 and len(m.points) == 1 and np.allclose(m.points[0], first) for m in red)
            own = drawing.stored.object_model
            T = drawing.stored.T_world_ee @ np.linalg.inv(drawing.stored.T_obj_ee_attached)
            blade = own.vertices[own.faces[own.sharp_face]].reshape(-1, 3) @ T[:3, :3].T + T[:3, 3]
            assert (blade.min(0) - 1e-6 <= first).all() and (first <= blade.max(0) + 1e-6).all()
        assert row["split"] == "S0" or all(m.geom != drawing.model.geom(REGION).id for m in red)
        assert drawing.fails_at_s is not None and "witness" in drawing.groups(fails=True)


def drawing_words(by, row):
    who = {Nearer.GRIPPER: "the gripper", Nearer.SHARP: "a sharp part"}[by]
    wanted = "the receiver's part" if row["split"] == "S1" else "the object"
    room = PRESENTED_M[row["split"]]
    return f"{who} is {100 * (room - row['margin_presented_m']):.1f} cm nearer to the palm than {wanted}"


def test_the_panel_tells_it_of_a_benchmark_that_does_not_ask(found):
    drawing, trial, asked, _ = found[Nearer.GRIPPER]
    shown = as_markdown(drawing)
    assert "presented fails" in shown and "no part of the verdict" not in shown
    plain = load_benchmark("r2h-v2")
    evaluator = Evaluator(plain, EvalConfig(execute=ExecConfig(sim="none")))
    shown = as_markdown(Drawing(judged_again(evaluator, trial, asked, "random")))
    assert "success" in shown and "is no part" not in shown
    assert "nearer to the palm" in shown and "(Presented: no part of the verdict)" in shown
