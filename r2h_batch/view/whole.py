"""A film of a whole handover: what cameras saw, and the trial as it was judged."""

from collections.abc import Iterator

from r2h_batch.observe.sees import Sees
from r2h_batch.view.drawing import Drawing
from r2h_batch.view.film import Clip, Story
from r2h_batch.view.pictures import Image
from r2h_batch.view.sees import shown_to
from r2h_batch.view.stored import Reader

SEEN_S = 3.0
"""How long a film shows what cameras saw [choice]."""


def story_of(reader: Reader, drawing: Drawing, fps: int) -> Story:
    """A stored trial with what stands before its motion.

    Args:
        reader: of its run folder.
        drawing: the trial.
        fps: pictures a second.
    """
    return Story(drawing, _seen(reader, drawing, fps))


def _seen(reader: Reader, drawing: Drawing, fps: int) -> Clip | None:
    """The method's view, where it did not know the truth."""
    sees = Sees.of_run(reader.run.header)
    if sees is None:
        return None
    count = round(SEEN_S * fps)

    def images(size: tuple[int, int]) -> Iterator[Image]:
        yield from [shown_to(reader, sees, int(drawing.stored.row["trial_id"]), size)] * count

    return Clip(count, images, "what the cameras see")
