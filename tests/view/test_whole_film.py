"""Films of whole handovers: what cameras saw stands before the legs and the motion."""

import json

import numpy as np
import pytest
from needs import needs

from r2h_batch.base.errors import UsageError
from r2h_batch.observe.sees import Sees
from r2h_batch.sweep.command import main as sweep
from r2h_batch.view.drawing import Drawing
from r2h_batch.view.film import Caption, Clip, Story, write_film
from r2h_batch.view.stored import Reader
from r2h_batch.view.whole import SEEN_S, story_of

SEES = "cell-v1,noise=0.5,labels=grown,model=known,object=field,region=told,seed=3"


@pytest.fixture(scope="module")
def reader(tmp_path_factory):
    out = tmp_path_factory.mktemp("whole") / "run"
    line = ["--benchmark", "r2h-v3", "--method", "learned", "--trials", "2", "--execute.sim", "none"]
    assert sweep([*line, "--sees", SEES, "--out", str(out)]) == 0
    return Reader(out)


@pytest.fixture(scope="module")
def drawing(reader):
    """A row of `learned` that was picked, carried and received. It is not changed."""
    method = reader.method("learned")
    row = next(r for r in reader.rows(method).to_pylist() if r["passed_received"])
    return Drawing(reader.trial(row["trial_id"], method))


@pytest.mark.whole(part="view")
@needs("gl")
def test_a_row_is_told_from_the_cameras_on(reader, drawing):
    story = story_of(reader, drawing, 4)
    assert story.before.length == round(4 * SEEN_S)
    seen = list(story.before.images((320, 240)))
    assert len(seen) == story.before.length and seen[0].shape == (240, 320, 3)
    assert seen[0].std() > 10  # no empty picture


@pytest.mark.whole(part="view")
@needs("gl")
def test_a_film_keeps_the_order_and_says_the_verdict_at_its_end_alone(drawing, tmp_path, monkeypatch):
    said = []
    around = Caption.around

    def listening(self, image, head, words):
        said.append((int(image[0, 0, 0]), tuple(words)))
        return around(self, image, head, words)

    monkeypatch.setattr(Caption, "around", listening)
    gray = Clip(3, lambda size: (np.full((size[1], size[0], 3), 11, np.uint8) for _ in range(3)), "seen")
    write_film([Story(drawing, gray)], tmp_path / "x.gif", size=(240, 180), fps=2)
    words = [w for _, w in said]
    assert [g for g, _ in said[:3]] == [11] * 3 and words[:3] == [("seen", "")] * 3
    does = [w[1] for w in words[3:]]
    assert does[0] == "picks" and "lifts" in does
    motion = does[len(does) - does[::-1].index("lifts") :]
    verdicts = [w for w in motion if w]
    assert len(verdicts) >= 3 and set(verdicts) == {motion[-1]}  # of the motion's end, and of the rest behind it
    assert motion[: -len(verdicts)] and not any(motion[: -len(verdicts)])


def test_the_sight_of_a_run_is_read_back_from_its_header(reader):
    sees = Sees.of_run(reader.run.header)
    assert sees == Sees.parse(SEES).on(reader.benchmark)
    assert Sees.of_run({}) is None and Sees.of_run({"sees": None}) is None


@pytest.mark.parametrize("change", [{"rig": "/etc/passwd"}, {"rig": "mine.toml"}, {"rig_digest": "0" * 64}])
def test_cameras_of_a_file_are_not_opened(reader, change):
    header = json.loads(json.dumps(reader.run.header))
    header["sees"] |= change
    assert Sees.of_run(header) is None


def test_a_header_with_words_that_are_none_is_one_line(reader):
    header = json.loads(json.dumps(reader.run.header))
    header["sees"] |= {"noise": "much"}
    with pytest.raises(UsageError, match="noise is 'much'"):
        Sees.of_run(header)
