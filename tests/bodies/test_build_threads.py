"""Building on one BLAS thread, for as long as it lasts, whatever else builds meanwhile."""

import numpy as np
import pytest
import torch
import trimesh
from threadpoolctl import threadpool_info, threadpool_limits

from r2h_batch.bodies.objects import build_object
from r2h_batch.methods.grasps import sample
from r2h_batch.receiver import sampler

pytestmark = pytest.mark.check


def blas() -> set[int]:
    np.ones((2, 2)) @ np.ones((2, 2))
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


@pytest.fixture(autouse=True)
def _two_threads():
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    with threadpool_limits(2, user_api="blas"):
        yield
    torch.set_num_threads(threads)


def test_an_object_its_grasps_and_its_holds_are_made_on_one_thread(monkeypatch) -> None:
    seen: dict[str, tuple[set[int], int]] = {}

    def noted(module, name):
        plain = getattr(module, name)

        def note(*args, **kwargs):
            seen[name] = blas(), torch.get_num_threads()
            return plain(*args, **kwargs)

        monkeypatch.setattr(module, name, note)

    from r2h_batch.bodies import objects

    for module, name in ((objects, "closed_mesh"), (sample, "graded"), (sampler, "come_down")):
        noted(module, name)
    box = build_object(trimesh.creation.box((0.05, 0.06, 0.1)), "box")
    sample.sample_grasps(box, count=10, enough=10)
    sampler.sample_receiving(box, per_side=1)
    assert seen == {"closed_mesh": ({1}, 2), "graded": ({1}, 1), "come_down": ({1}, 1)}  # torch builds no mesh
    assert blas() == {2} and torch.get_num_threads() == 2
