"""Preset `release`: each definition of the authors' release that it takes, against the definition itself."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from problems import default_evaluator, make_batch
from rounds import each

from r2h_batch import load_benchmark
from r2h_batch.base.registry import PRESET_NAMES
from r2h_batch.config import OPEN_GAP_M, EvalConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.motion.time_law import time_path
from r2h_batch.methods import fc, handover_va
from r2h_batch.methods.candidates import candidates_of
from r2h_batch.report.statistics import aggregate
from r2h_batch.sweep.command import main as sweep
from r2h_batch.verdicts import CRITERIA


def test_reach_measures_the_hull_and_the_solid_where_it_is_told():
    scene = default_evaluator().scene
    batch = make_batch(scene, 64)
    judged = Evaluator(load_benchmark("r2h-v1").with_objects(scene.objects), replace(EvalConfig(), reach="hull"))
    solid, hull = (
        e.score(batch.T_obj_ee, batch.T_world_ee, batch.trials, stages="pose").margin[:, CRITERIA.index("reach")]
        for e in (default_evaluator(), judged)
    )
    _, _, ball = scene.palm(batch.trials.hand_index, batch.trials.T_world_hand)
    held = default_evaluator().score(batch.T_obj_ee, batch.T_world_ee, batch.trials, stages="pose")
    nearer = 0
    for i in range(0, 64, 2):
        if torch.isnan(hull[i]):
            continue
        model = scene.objects[int(batch.trials.object_index[i])]
        shape = trimesh.Trimesh(model.hull_vertices.astype(float), model.hull_faces, process=False)
        T_obj_ee = batch.T_obj_ee[i].double().numpy()
        T_obj_ee[:3, 3] -= float(held.grasp_shift_m[i]) * T_obj_ee[:3, 1]  # closing moved the object along y
        T = T_obj_ee @ np.linalg.inv(batch.T_world_ee[i].double().numpy())
        x = T[:3, :3] @ ball[i].double().numpy() + T[:3, 3]
        distance = max(-trimesh.proximity.signed_distance(shape, x[None])[0], 0.0)
        assert float(hull[i]) == pytest.approx(0.10 - distance, abs=2e-5) and hull[i] >= solid[i] - 1e-6
        nearer += float(hull[i] - solid[i]) > 1e-3
    assert nearer >= 3


def test_narrow_candidates_are_those_across_which_the_whole_object_fits():
    objects = default_evaluator().scene.objects
    fewer = 0
    for model, every, some in zip(objects, candidates_of(objects), candidates_of(objects, "narrow"), strict=True):
        across = np.ptp(model.vertices.astype(float) @ every.T_obj_ee[:, :3, 1].T.astype(float), axis=0)
        kept = across <= OPEN_GAP_M if (across <= OPEN_GAP_M).any() else np.ones(len(across), bool)
        assert np.array_equal(some.T_obj_ee, every.T_obj_ee[kept])
        fewer += kept.sum() < len(kept)
    assert fewer >= 8


def test_speed_is_constant_and_no_joint_is_faster_than_the_releases():
    q = torch.tensor([[[0.0] * 6, [0.3, -0.9, 0, 0, 0, 0], [0.3, -0.9, 0, 0, 0.6, 0]]])
    took = time_path(q, torch.tensor([3], dtype=torch.int32), EvalConfig.preset("release").execute).t_exec_s
    assert float(took) == pytest.approx(1.5 / 0.6, abs=2e-3)


def test_every_object_counts_the_same_in_its_averages(tmp_path, capsys):
    from r2h_batch.report.statistics.tally import tally
    from r2h_batch.runs.store import load_run

    line = ["--method", "random", "--benchmark", "r2h-release", "--preset", "release", "--trials", "13"]
    assert sweep([*line, "--splits", "S0", "--out", str(tmp_path / "run")]) == 0
    assert "averages: objects of a split count the same" in " ".join(capsys.readouterr().out.split())
    run = load_run(tmp_path / "run")
    assert run.header["configuration"]["execute"]["sim"] == "none" and run.header["configuration"]["reach"] == "hull"
    rows = run.trials("random").to_pylist()
    names = {r["object"] for r in rows}
    counts = [sum(r["object"] == n for r in rows) for n in names]
    assert len(names) == 8 and set(counts) == {1, 2}  # 13 trials of 8 objects
    wanted = np.mean([np.mean([r["outcome"] == "reach" for r in rows if r["object"] == n]) for n in names])
    (row,) = aggregate.summarise([tally(run, "random")], "objects")
    (plain,) = aggregate.summarise([tally(run, "random")])
    assert row.rates["f_reach"].percent == pytest.approx(100 * wanted)
    assert sum(r.percent for r in row.rates.values() if r) == pytest.approx(100) and row.n == plain.n == 13
    assert row.rates["f_reach"].percent != pytest.approx(plain.rates["f_reach"].percent) or wanted in (0, 1)


@pytest.mark.parametrize("method", [fc, handover_va], ids=lambda m: m.TITLE)
def test_methods_choose_narrow_grasps_wherever_there_is_one(method):
    scene = Evaluator(load_benchmark("r2h-v1"), replace(EvalConfig(), candidates="narrow")).scene
    trials = load_benchmark("r2h-v1").trials(16)
    answer = method.predict(trials, scene)
    across = [
        np.ptp(scene.objects[o].vertices.astype(float) @ T[:3, 1].double().numpy())
        for o, T in zip(trials.object_index.tolist(), answer.T_obj_ee, strict=True)
    ]
    wide = {scene.objects[o].name for o, w in zip(trials.object_index.tolist(), across, strict=True) if w > OPEN_GAP_M}
    assert wide == {"bowl"}  # no candidate of it is narrow


@pytest.mark.check
def test_an_evaluator_takes_a_preset_by_its_name() -> None:
    benchmark = load_benchmark("r2h-v0")
    for name in each(PRESET_NAMES):
        assert Evaluator(benchmark, name).config == Evaluator(benchmark, EvalConfig.preset(name)).config
    with pytest.raises(ValueError, match="config is 'papers'; allowed are default, paper, release"):
        Evaluator(benchmark, "papers")
