"""Methods that see are asked in a process that holds no truth (r2h_batch.observe.apart, asked)."""

import os
import signal
from functools import cache

import numpy as np
import pytest
import torch
from rays_twin import RIG, cell
from rounds import each

from r2h_batch.base.errors import AnswerError
from r2h_batch.methods.predictors import predict_parts
from r2h_batch.observe.apart import Apart
from r2h_batch.observe.messages import receive
from r2h_batch.observe.seeing import look
from r2h_batch.observe.seen import Observation, packed, unpacked

SPY = '''
"""Writes all that it can reach from where it is asked: tensors, arrays, texts, files."""
import gc, os, pickle, sys
import numpy as np
import torch

def inside(value, found, known):
    left = [value]
    while left:
        x = left.pop()
        if id(x) in known:
            continue
        known[id(x)] = x
        kind = type(x)
        if issubclass(kind, torch.Tensor):
            found["arrays"].append(x.detach().cpu().contiguous().numpy().tobytes())
        elif issubclass(kind, np.ndarray):
            found["arrays"].append(np.ascontiguousarray(x).tobytes() if x.dtype != object else b"")
        elif issubclass(kind, (bytes, bytearray, memoryview)):
            found["arrays"].append(bytes(x))
        elif issubclass(kind, str):
            found["texts"].append(str.encode(x, errors="replace"))
        else:
            left += gc.get_referents(x)

def predict(seen, *, place=""):
    found, known = {"arrays": [], "texts": []}, {}
    frame = sys._getframe()
    while frame is not None:
        inside([dict(frame.f_locals), dict(frame.f_globals)], found, known)
        frame = frame.f_back
    inside([gc.get_objects(), dict(sys.modules), dict(os.environ), sys.argv], found, known)
    found["modules"] = sorted(sys.modules)
    links = [f"/proc/self/fd/{k}" for k in os.listdir("/proc/self/fd")]
    found["files"] = [os.readlink(link) for link in links if os.path.exists(link)]
    with open(place, "wb") as file:
        pickle.dump(found, file)
    eye = torch.eye(4).repeat(len(seen), 1, 1)
    return eye, eye
'''


@cache
def view(model=None, region="hidden"):
    scene, trials, T = cell()
    return look(scene, trials, RIG, T, model=model, region=region)


def method(tmp_path, text, name="mine"):
    file = tmp_path / f"{name}.py"
    file.write_text(text)
    return f"{file}:predict"


@pytest.mark.parametrize(
    ("model", "region"),
    [
        (None, "hidden"),
        ("lab", "told"),
        *(pytest.param(*more, marks=pytest.mark.whole(part="observe")) for more in (("lab", "hidden"), (None, "told"))),
    ],
)
def test_an_observation_comes_out_of_the_pipe_as_it_went_in(model, region):
    seen = view(model, region)
    again = unpacked(packed(seen))
    assert list(packed(again)) == list(packed(seen))
    for name, array in each(packed(seen).items()):
        assert np.array_equal(packed(again)[name], array) and packed(again)[name].dtype == array.dtype
    assert len(again.known.vertices) == len(again.known.faces) >= 2 if model else again.known is None
    assert isinstance(again, Observation) and len(again[1:3]) == 2
    if region == "told":
        assert torch.equal(again[1:3].region, seen.region[1:3])
        assert torch.equal(again[5:6].cloud_region(99), seen.cloud_region(99)[5:6])
    else:
        assert again.region is None


@pytest.mark.check
@pytest.mark.parametrize("region", ["hidden", pytest.param("told", marks=pytest.mark.whole(part="observe"))])
def test_a_spy_finds_no_pose_no_object_no_hand_and_no_name_of_the_truth_in_all_that_it_can_reach(region, tmp_path):
    import pickle

    scene, trials, T = cell()
    place, seen = tmp_path / "found.pickle", view(None, region)
    Apart(method(tmp_path, SPY, "spy"), {"place": str(place)}, 1).ask(seen)
    found = pickle.loads(place.read_bytes())
    # what it may have is there: so the walk reaches what it is shown
    everything = b"".join(found["arrays"])
    own = () if region == "hidden" else (view(None, "told").region[4:5],)
    for shown in each((seen.receiver.palm, seen.object.depth_m, *own)):
        assert shown[0].numpy().tobytes() in everything
    for i in each(range(len(trials))):
        model, hand = scene.objects[int(trials.object_index[i])], int(trials.hand_index[i])
        parts = predict_parts(trials[i : i + 1], scene)
        secrets = (
            T[i], T[i].double(), torch.linalg.inv(T[i].double()), trials.T_world_hand[i], trials.receiver[i],
            torch.tensor(model.vertices[:8]), torch.tensor(model.points[:8]), scene.hands.vertices[hand, :8],
            RIG.T_world_camera[0], torch.tensor(model.point_part[None]), parts.label, parts.usage,
        )  # fmt: skip
        for secret in each(s for s in secrets if len(torch.unique(s)) > 1):  # an object of S0 has no region
            rows = [row for row in secret.reshape(len(secret), -1) if len(torch.unique(row)) > 3] or [secret]
            assert all(row.contiguous().numpy().tobytes() not in everything for row in rows)
        assert not any(model.name.encode() in text for text in found["texts"])
    rooms = ("scene", "trials", "judge", "data", "evaluate", "types", "sweep", "methods")
    assert not [m for m in found["modules"] if m.startswith(tuple(f"r2h_batch.{room}" for room in rooms))]
    assert not any(text.endswith((".npz", ".obj", ".parquet")) for text in found["files"])


REACHES = """
from r2h_batch import load_benchmark; load_benchmark('r2h-v2')
import r2h_batch.scene.scene
from r2h_batch.observe import observe; observe
import importlib; importlib.import_module('r2h_batch.trials.noise')
""".strip().splitlines()
IN_TURN = """
def raises(error):
    raise error

ASKED = [{asked}]

def predict(seen):
    return ASKED.pop(0)(seen)
"""
"""A method that does one thing after the other, each time that it is asked: its process starts once."""


def test_a_method_that_reaches_for_the_truth_is_refused_in_one_line(tmp_path):
    text = IN_TURN.format(asked=", ".join(f"lambda seen: exec({line!r})" for line in REACHES))
    apart = Apart(method(tmp_path, text), {}, 1)
    for line in each(REACHES):
        with pytest.raises(AnswerError, match="a method that sees cannot have it") as refused:
            apart.ask(view())
        assert "\n" not in str(refused.value), line


def test_what_a_method_needs_of_the_package_it_may_import(tmp_path):
    text = "from r2h_batch.base import se3\nfrom r2h_batch.observe.seen import LABELS, Observation\n" + SAYS_ITS_KEY
    grasp, _, _ = Apart(method(tmp_path, text), {}, 1).ask(view())
    assert torch.equal(grasp[:, 0, 3].long(), view().key % 1000)


SAYS_ITS_KEY = """
import torch

def predict(seen, *, seed=0):
    print("a line that is no answer")
    grasp = torch.eye(4, dtype=torch.float64).repeat(len(seen), 1, 1)
    grasp[:, 0, 3] = (seen.key % 1000).double()
    handover = grasp.clone()
    handover[:, 0, 3] = seen.receiver.palm[:, 0].double()
    assert bool((seen.key[1:] >= seen.key[:-1]).all())
    return grasp, handover.numpy().tolist()
"""


def test_answers_come_back_to_their_own_trials_whatever_the_order_and_the_batch(tmp_path):
    apart = Apart(method(tmp_path, SAYS_ITS_KEY), {"seed": 3}, 1)
    seen = view()
    for rows in each((torch.arange(len(seen)), torch.tensor([3, 1, 5]), torch.tensor([2]))):
        grasp, handover, seconds = apart.ask(seen[rows])
        assert torch.equal(grasp[:, 0, 3].long(), seen.key[rows] % 1000)
        assert torch.equal(handover[:, 0, 3].float(), seen.receiver.palm[rows, 0])
        assert (seconds >= 0).all() and len(seconds) == len(rows)


WRONG = {
    "3": "its answer is a int; it must be (T_world_grasp, T_world_ee)",
    "([[1.0]], [[1.0]])": "T_world_grasp is torch.float64 (1, 1); it must be a tensor (8, 4, 4) of torch.float32 or",
    "seen.known.mesh": "seen.known is None: the objects' models are not told, give --sees RIG,model=known",
    "raises(KeyError('x'))": "KeyError: 'x' (",
    "raises(SystemExit(4))": "SystemExit: 4 (",
    "__import__('os')._exit(7)": "its process ended with code 7",
}
"""What a method does -> words of the line about it; the last one ends its process."""


def test_what_a_method_does_wrong_is_said_in_one_line(tmp_path):
    apart = Apart(method(tmp_path, IN_TURN.format(asked=", ".join(f"lambda seen: {what}" for what in WRONG))), {}, 1)
    for what, words in each(WRONG.items()):
        with pytest.raises(AnswerError) as refused:
            apart.ask(view())
        assert words in str(refused.value) and "\n" not in str(refused.value), what


def test_a_method_whose_file_cannot_be_imported_is_said_in_one_line(tmp_path):
    with pytest.raises(AnswerError, match="ModuleNotFoundError: No module named 'nothing_like_this'") as refused:
        Apart(method(tmp_path, "import nothing_like_this\n"), {}, 1).ask(view())
    assert "\n" not in str(refused.value)


ANSWERS = """
import torch

ANSWERS = [
    lambda T: (T[1:], T[1:]),
    lambda T: (T, None),
    lambda T: (T.to(torch.complex64), T),
    lambda T: (T, T.numpy().astype(complex)),
    lambda T: (T.numpy().astype(str), T),
    lambda T: (T.half(), T),
    lambda T: (T.to_sparse(), T),
    lambda T: None.mesh_of,
    lambda T: (T.requires_grad_(), T.long().tolist()),
]

def predict(seen):
    return ANSWERS.pop(0)(torch.eye(4).repeat(len(seen), 1, 1))
"""


def test_what_is_no_real_numbers_of_the_right_shape_is_refused_and_the_process_answers_on(tmp_path):
    apart = Apart(method(tmp_path, ANSWERS), {}, 1)
    for words in each(
        (
            "T_world_grasp is torch.float32 (7, 4, 4); it must be a tensor (8, 4, 4) of torch.float32 or torch.float64",
            "T_world_ee is None; it must be",
            # NumPy would take their real parts, and read texts
            "T_world_grasp is torch.complex64; it must be",
            "T_world_ee is a ndarray of shape (8, 4, 4) and type complex128; it must be",
            "T_world_grasp is a ndarray of shape (8, 4, 4) and type <U",
            "T_world_grasp is torch.float16; it must be",
            "T_world_grasp is a tensor of layout sparse_coo; it must be",
            "AttributeError: 'NoneType' object has no attribute 'mesh_of' (",
        )
    ):
        with pytest.raises(AnswerError) as refused:
            apart.ask(view())
        said = str(refused.value)
        assert words in said and "\n" not in said and "model=known" not in said
    grasp, handover, _ = apart.ask(view())
    assert torch.equal(grasp, torch.eye(4, dtype=torch.float64).repeat(8, 1, 1)) and torch.equal(handover, grasp)


WRITES = """
import io
import os
import struct

import numpy as np


def message(*names):
    file = io.BytesIO()
    for array in (np.array(str(list(names)).replace("'", '"')), *(np.zeros((2, 4, 4)) for _ in names)):
        np.save(file, array)
    return struct.pack("<Q", file.tell()) + file.getvalue()


def predict(seen):
    for fd in range(3, 64):
        try:
            os.write(fd, {words})
        except OSError:
            pass
"""


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("b'\\xff' * 64", "its process wrote a message of 18446744073709551615 bytes; at most"),
        pytest.param(
            "struct.pack('<Q', 50) + b'x' * 50", "its process wrote bytes that are no message", marks=pytest.mark.slow
        ),
        (
            "message('T_world_grasp', 'T_world_ee', 't_method_s')",
            "its process wrote T_world_grasp as (2, 4, 4) float64",
        ),
        pytest.param("message('x')", "its process wrote T_world_grasp as (0,) object", marks=pytest.mark.slow),
    ],
)
def test_what_a_method_writes_into_the_pipe_itself_is_said_in_one_line_and_its_process_ends(words, said, tmp_path):
    apart = Apart(method(tmp_path, WRITES.replace("{words}", words)), {}, 1)
    with pytest.raises(AnswerError) as refused:
        apart.ask(view())
    assert said in str(refused.value) and "\n" not in str(refused.value) and apart.process_id is None


@pytest.mark.alone
def test_a_process_that_was_killed_is_started_anew_and_one_that_nobody_asks_ends(tmp_path):
    from alive import alive

    apart = Apart(method(tmp_path, f"{SAYS_ITS_KEY}\nimport os\n"), {}, 1)
    apart.ask(view())
    first = apart.process_id
    os.kill(first, signal.SIGKILL)
    with pytest.raises(AnswerError, match="ended with code -9"):
        apart.ask(view())
    apart.ask(view())
    second = apart.process_id
    assert second != first and alive(second)
    del apart
    assert not alive(second)


def test_a_pipe_that_no_longer_waits_is_one_that_has_ended():
    ends = os.pipe()
    os.set_blocking(ends[0], False)  # a method can do so to a pipe that it finds
    with os.fdopen(ends[0], "rb") as pipe, os.fdopen(ends[1], "wb"):
        assert receive(pipe, 100) is None
