"""A film of a transfer: hand, gripper and object, the forces as arrows, and how it ended."""

import numpy as np
import pytest
from needs import needs

from r2h_batch.__main__ import main
from r2h_batch.report.compare.stored import ROWS

VIEW = ["view", str(ROWS / "v1"), "--method", "oracle", "--trial"]


@needs("gl")
def test_a_film_shows_the_object_in_the_gripper_then_in_the_hand_and_the_force_that_pulls(tmp_path, capsys):
    from PIL import Image, ImageSequence

    file = tmp_path / "hammer.gif"
    words = [*VIEW, "21", "--transfer", "take", "--video", str(file), "--size", "320", "240", "--fps", "4"]
    assert main(words) == 0
    assert capsys.readouterr().out.strip() == f"{file}: taken"
    frames = [np.asarray(f.convert("RGB")).astype(int)[60:] for f in ImageSequence.Iterator(Image.open(file))]
    assert len(frames) >= 5

    def mostly(channel: int, image: np.ndarray) -> np.ndarray:
        """Columns with pixels of which one channel is clearly the largest."""
        others = np.delete(image, channel, axis=2).max(2)
        return np.flatnonzero((image[..., channel] - others > 30).any(0))

    objects = [mostly(2, image) for image in frames]
    assert len(objects[0]) and not np.array_equal(objects[0], objects[-1])  # the hand has taken it away
    pulls = [len(mostly(1, image)) for image in frames]
    assert pulls[0] == 0 and max(pulls) > 0  # nobody pulls at first


@needs("gl")
@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--transfer", "grab", "--video", "a.gif"], "choose take, touch"),
        (["--transfer", "take", "--release", "soon", "--video", "a.gif"], "no release policy is called 'soon'"),
        (["--transfer", "take"], "--transfer needs --video"),
        (["--transfer", "take", "--video", "a.gif", "--strips", "a.png"], "no other output"),
    ],
)
def test_what_a_film_of_a_transfer_needs_is_said(more, said, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main([*VIEW, "21", *more]) == 2
    assert said in capsys.readouterr().err


@needs("gl")
def test_a_row_that_nobody_receives_has_no_transfer_to_show(tmp_path, capsys):
    import torch

    from r2h_batch.judge.reception import reception
    from r2h_batch.protocols.choice import DEFAULT
    from r2h_batch.runs.store import load_run
    from r2h_batch.sweep.results.reception import judge_of_bodies, judged_one

    run = load_run(ROWS / "v1").only(["oracle"])
    judge, (name,) = judge_of_bodies(run, DEFAULT, "cpu")
    refused = None
    for trial in range(20, 60):
        _, scores, _ = judged_one(run, name, judge, trial)
        if not bool(torch.as_tensor(reception(scores).received)[0]):
            refused = trial
            break
    assert refused is not None
    assert main([*VIEW, str(refused), "--transfer", "take", "--video", str(tmp_path / "a.gif")]) != 0
    assert "nobody receives the object" in capsys.readouterr().err
    assert not (tmp_path / "a.gif").exists()
