"""What is known of a scene is kept by its arguments, and as long as the scene."""

import gc
import weakref

from r2h_batch.scene import kept


class Owner:
    """Stands for a scene."""


def test_answers_are_those_of_their_arguments_computed_once_and_go_with_their_owner():
    asked = []

    @kept.KeptWith
    def answer(owner, x, y=0):
        asked.append((x, y))
        return [x, y]

    a, b = Owner(), Owner()
    for _ in range(2):
        assert (
            answer(a, 1) == [1, 0] and answer(a, 2) == [2, 0] and answer(a, 1, y=3) == [1, 3] and answer(b, 1) == [1, 0]
        )
    assert asked == [(1, 0), (2, 0), (1, 3), (1, 0)]
    assert answer(a, 1) is answer(a, 1) and answer(a, 1) is not answer(b, 1)
    gone = weakref.ref(a)
    del a
    gc.collect()
    assert gone() is None


def test_of_one_owner_the_last_answers_stay():
    asked = []
    answer = kept.KeptWith(lambda owner, x: asked.append(x))
    owner = Owner()
    for x in [*range(kept.MOST + 1), kept.MOST, 0]:
        answer(owner, x)
    assert asked == [*range(kept.MOST + 1), 0]
