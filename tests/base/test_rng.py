"""Counter-based random numbers: the published answers of Philox, and uniform draws and rotations."""

import math

import numpy as np
import pytest
from scipy import stats

from r2h_batch.base import rng


@pytest.mark.parametrize(
    ("counter", "key", "answer"),
    [
        ((0, 0, 0, 0), (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
        ((0xFFFFFFFF,) * 4, (0xFFFFFFFF,) * 2, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
        (
            (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
            (0xA4093822, 0x299F31D0),
            (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
        ),
    ],
)
def test_philox_gives_the_known_answers_of_random123(counter, key, answer):
    got = rng.philox4x32(np.array(counter, np.uint64)[:, None].repeat(3, 1), key)
    assert [tuple(int(w) for w in column) for column in got.T] == [answer] * 3


def test_uniform_draws_depend_on_every_word_of_the_counter_and_fill_the_interval():
    ids = np.arange(50_000) + 2**33
    u = rng.uniforms((1, 2), ids, 7, purpose=3, attempt=4)
    assert u.shape == (7, 50_000) and u.min() > 0 and u.max() < 1
    for row in u:
        assert stats.kstest(row, "uniform").pvalue > 1e-3
    assert abs(np.corrcoef(u)[np.triu_indices(7, 1)]).max() < 0.02
    for other in (
        rng.uniforms((1, 3), ids, 7, purpose=3, attempt=4),
        rng.uniforms((1, 2), ids - 2**33, 7, purpose=3, attempt=4),
        rng.uniforms((1, 2), ids, 7, purpose=2, attempt=4),
        rng.uniforms((1, 2), ids, 7, purpose=3, attempt=5),
    ):
        assert (u == other).mean() < 1e-3
    assert np.array_equal(rng.uniforms((1, 2), ids[5:6], 3, purpose=3, attempt=4)[:, 0], u[:3, 5])


def test_rotations_are_proper_and_uniform():
    inside, R = rng.rotation(rng.uniforms((5, 6), np.arange(60_000), 4, purpose=0))
    assert inside.mean() == pytest.approx((math.pi / 4) ** 2, abs=0.01)
    R = R[inside]
    assert np.abs(np.einsum("nij,nkj->nik", R, R) - np.eye(3)).max() < 1e-14 and np.linalg.det(R).min() > 0.99
    for entry in (R[:, 0, 0], R[:, 1, 2], R[:, 2, 2]):  # each entry of a uniform rotation is uniform in [-1, 1]
        assert stats.kstest(entry, "uniform", (-1, 2)).pvalue > 1e-3
    angle = np.arccos(np.clip((np.trace(R, axis1=1, axis2=2) - 1) / 2, -1, 1))
    assert stats.kstest(angle, lambda a: (a - np.sin(a)) / np.pi).pvalue > 1e-3
