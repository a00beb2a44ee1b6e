"""Claims about transfers in batched MuJoCo-Warp worlds, held against MuJoCo C."""

from dataclasses import fields, replace
from unittest import mock

import numpy as np
import pytest
import torch
import warp as wp
from pretend_cuda import OnCuda, pretending
from rounds import each
from screwdriver import OBJECTS, ROBOT, screwdrivers

from r2h_batch.closed_loop.transfer import worlds_mjwarp
from r2h_batch.closed_loop.transfer.batched import BatchedSimulator
from r2h_batch.closed_loop.transfer.cases import Case, Simulator, Transferred
from r2h_batch.closed_loop.transfer.handed import Handed
from r2h_batch.closed_loop.transfer.model import TICK_S, Setting
from r2h_batch.closed_loop.transfer.outcome import free_at
from r2h_batch.closed_loop.transfer.release import second_singular_exceeds
from r2h_batch.closed_loop.transfer.simulate import Transfers
from r2h_batch.closed_loop.transfer.worlds_mjwarp import Batch

CASES = [Case("load-share", "take", 0), Case("probe", "take", 0), Case("threshold", "touch", 0)]
NUMBERS = [f.name for f in fields(Transfers) if f.name != "outcome"]


def knives_and_screwdrivers() -> Handed:
    """Two objects with different pieces, masses and grasps, in turn."""
    parts = screwdrivers(2), screwdrivers(2, below_m=0.04, index=1)
    both = Handed(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Handed)))
    return replace(both, trial_id=np.arange(4))[np.array([0, 2, 1, 3])]


@pytest.fixture(scope="module")
def exact() -> Simulator:
    return Simulator(ROBOT, OBJECTS, Setting(), seed=0)


@pytest.fixture(scope="module")
def batched() -> BatchedSimulator:
    return BatchedSimulator(ROBOT, OBJECTS, Setting(), seed=0)


def same_bits(a: Transferred, b: Transferred) -> bool:
    return a.transfers.outcome == b.transfers.outcome and all(
        np.array_equal(getattr(a.transfers, k), getattr(b.transfers, k), equal_nan=True) for k in NUMBERS
    )


def test_worlds_with_different_objects_agree_with_mujoco_c(exact, batched):
    """Where the gripper is free at the same tick, which it is in all but one transfer at most; there it is the next one."""
    handed, other_ticks = knives_and_screwdrivers(), 0
    for one, (two, doubt) in each(zip(exact(handed, CASES), batched.worlds(handed, CASES), strict=True)):
        a, b = one.transfers, two.transfers
        assert a.outcome == b.outcome and not doubt.any()
        assert not same_bits(one, two)  # float32: they were not copied
        off = np.abs(a.time_s - b.time_s)
        same = off < 1e-9
        other_ticks += int((~same).sum())
        assert (off < 1.5 * TICK_S).all()
        # under a shake contacts creep, and what float32 changes adds up
        creep = 2e-4 if one.case.release == "probe" else 2e-5
        for name, most in {"pull_n": 0.05, "hand_n": 0.05, "slip_m": creep, "robot_slip_m": creep}.items():
            assert np.allclose(getattr(a, name)[same], getattr(b, name)[same], rtol=0, atol=most), name
        assert np.allclose(a.transfer_s[same], b.transfer_s[same], rtol=0, atol=1e-9, equal_nan=True)
        assert np.allclose(a.turn_deg[same], b.turn_deg[same], rtol=0, atol=0.2)
    assert other_ticks <= 1


def test_a_row_does_not_depend_on_its_batch(batched):
    handed = knives_and_screwdrivers()
    (whole,), (alone,) = (batched(rows, CASES[:1]) for rows in (handed, handed[2:3]))
    for name in NUMBERS:
        assert np.array_equal(getattr(whole.transfers, name)[2:3], getattr(alone.transfers, name), equal_nan=True), name


def test_where_the_contacts_of_the_worlds_lie_mujoco_c_decides(exact, batched):
    handed, case = screwdrivers(2), [Case("never", "take", 0)]
    nothing_touches = mock.patch.object(
        Batch, "_touching", lambda self: torch.zeros(self.n, dtype=torch.bool, device="cpu")
    )
    with nothing_touches:
        ((wrong, doubt),) = batched.worlds(handed, case)
        (made,) = batched(handed, case)
    assert wrong.transfers.outcome == ["torn_out"] * 2 and doubt.all()
    assert made.transfers.outcome == ["not_released"] * 2 and same_bits(made, exact(handed, case)[0])


def test_where_worlds_lose_contacts_mujoco_c_decides(exact, monkeypatch):
    monkeypatch.setattr(worlds_mjwarp, "NACON_PER_WORLD", 1)
    handed, small = screwdrivers(2), BatchedSimulator(ROBOT, OBJECTS, Setting(), seed=0)
    assert small.worlds(handed, CASES[:1])[0][1].all()
    assert same_bits(small(handed, CASES[:1])[0], exact(handed, CASES[:1])[0])


@pytest.mark.parametrize("policy", ["load-share", pytest.param("probe", marks=pytest.mark.slow)])
def test_on_a_gpu_the_host_waits_for_the_beginning_and_the_end_of_a_batch_only(policy, batched, monkeypatch):
    handed, case = screwdrivers(2), Case(policy, "take", 0)
    ((before, _),) = batched.worlds(handed, [case])
    batch = batched._batch[1]

    def there(x):
        return {k: there(v) for k, v in x.items()} if isinstance(x, dict) else OnCuda(x)

    names = ("data_of", "model_of", "at", "contact_m", "contact_world", "gravity", "before")
    monkeypatch.setattr(wp, "stream_from_torch", lambda stream: None)
    with pretending() as seen:
        for name in names:
            monkeypatch.setattr(batch, name, there(getattr(batch, name)))
        ((made, _),) = batched.worlds(handed, [case])
    assert same_bits(before, made)
    others = [where for _, where in seen.waits if "running.any" not in where]
    assert 2 <= len(seen.waits) - len(others) <= 8  # once in 32 ticks of 200
    began, *results = others
    assert "the worlds go on on torch's stream" in began
    assert all(where.startswith(("simulate.py", "outcome.py", "batched.py")) for where in results), results
    assert 10 < len(results) < 30  # a copy for each number, after the last tick


def test_the_tick_at_which_a_gripper_is_free_is_the_books():
    touching = np.ones((40, 3), bool)
    touching[25:, 0] = False  # four ticks apart: 25, 26, 27, 28
    touching[5:20, 1] = False  # apart before anybody comes, at tick 18 still
    touching[30:33, 2] = False  # too short
    assert free_at(touching).tolist() == [28, 18, 40]


def test_the_second_singular_value_is_numpys():
    rng = np.random.default_rng(0)
    A = rng.normal(size=(5000, 3, 3)) + 1j * rng.normal(size=(5000, 3, 3))
    A[::2] = A[::2] * rng.normal(size=(2500, 1, 3)) ** 4
    second = np.linalg.svd(A, compute_uv=False)[:, 1]
    columns = np.ascontiguousarray(np.moveaxis(A, 2, 0))
    for share in (1.0, 1e-6):
        least = second * (1 + share * rng.uniform(-1, 1, 5000))
        found = second_singular_exceeds(
            torch.from_numpy(columns.real.copy()), torch.from_numpy(columns.imag.copy()), torch.from_numpy(least)
        )
        assert np.array_equal(found.numpy(), second > least)
