"""A film of a whole handover: what cameras saw, the trial as it was judged, and how the person took the object."""

from collections.abc import Iterator

import torch

from r2h_batch.closed_loop.transfer.given import CASE
from r2h_batch.observe.sees import Sees
from r2h_batch.view.drawing import Drawing
from r2h_batch.view.film import Clip, Story
from r2h_batch.view.pictures import Image
from r2h_batch.view.sees import shown_to
from r2h_batch.view.stored import Reader
from r2h_batch.view.transfer import Shown

SEEN_S = 3.0
"""How long a film shows what cameras saw [choice]."""


def story_of(reader: Reader, drawing: Drawing, fps: int) -> Story:
    """A stored trial with what stands before and after its motion.

    Args:
        reader: of its run folder.
        drawing: the trial.
        fps: pictures a second.
    """
    return Story(drawing, _seen(reader, drawing, fps), _taken(reader, drawing, fps))


def _seen(reader: Reader, drawing: Drawing, fps: int) -> Clip | None:
    """The method's view, where it did not know the truth."""
    sees = Sees.of_run(reader.run.header)
    if sees is None:
        return None
    count = round(SEEN_S * fps)

    def images(size: tuple[int, int]) -> Iterator[Image]:
        yield from [shown_to(reader, sees, int(drawing.stored.row["trial_id"]), size)] * count

    return Clip(count, images, "what the cameras see")


def _taken(reader: Reader, drawing: Drawing, fps: int) -> Clip | None:
    """The transfer that Taken is about, where the trial got so far."""
    stored = drawing.stored
    if stored.row.get("passed_taken") is None:
        return None
    trial = reader.trial_of(stored.row)
    T_obj_ee, T_world_ee = (
        torch.from_numpy(T)[None].float() for T in (stored.T_obj_ee, stored.T_world_ee)
    )
    scores = reader.evaluator.score(T_obj_ee, T_world_ee, trial)
    shown = Shown.of(scores, trial.trial_id.numpy(), CASE)
    if shown is None:
        return None

    def images(size: tuple[int, int]) -> Iterator[Image]:
        yield from shown.images(size, fps)

    return Clip(shown.count(fps), images, "the person takes the object, seen from near")
