"""Moments of trials that were asked for before, or that somebody told: drawing one costs more than judging its trial."""

import weakref

import torch
from jaxtyping import Float32
from torch import Tensor

from r2h_batch.observe.moment import moments
from r2h_batch.scene.kept import KeptWith
from r2h_batch.scene.scene import Scene
from r2h_batch.types import Trials

MOST_KNOWN = 1 << 16
"""Moments that `KnownMoments` keeps."""


class KnownMoments:
    """Moments of a scene's trials, each drawn once: a method that searches asks for the same trials again and again.

    Args:
        scene: as of `moments`.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = weakref.ref(scene)  # with which it is kept
        self._known: dict[bytes, Tensor] = {}
        self._told: dict[bytes, Tensor] = {}

    def tell(self, trials: Trials, T_world_obj: Float32[Tensor, "n 4 4"]) -> None:
        """Let objects rest elsewhere than a draw says: where a method believes that it has seen them.

        Args:
            trials: N trials.
            T_world_obj: (N, 4, 4) where their objects rest, m.
        """
        self._told |= zip(_keys(trials), T_world_obj, strict=True)

    def tells_apart(self, trials: Trials) -> bool:
        """Whether each of N rows can be told a moment of its own: no two are of one trial and the same hand.

        Args:
            trials: N trials, whose ids may repeat.
        """
        keys = _keys(trials)
        return len(set(keys)) == len(keys)

    def of(self, trials: Trials) -> Float32[Tensor, "n 4 4"]:
        """As `moments`, but for trials that were told.

        Args:
            trials: N trials.
        """
        keys = _keys(trials)
        if len(self._known) + len(keys) > MOST_KNOWN:
            self._known.clear()
        new = [i for i, k in enumerate(keys) if k not in self._known and k not in self._told]
        if new:
            drawn = moments(self._of(), trials[new])
            self._known |= zip((keys[i] for i in new), drawn, strict=True)
        if not keys:
            return moments(self._of(), trials)
        return torch.stack([self._told[k] if k in self._told else self._known[k] for k in keys])

    def _of(self) -> Scene:
        scene = self._scene()
        assert scene is not None  # who asks has it
        return scene


def _keys(trials: Trials) -> list[bytes]:
    """All that decides the moment of each trial."""
    decide = [trials.trial_id, trials.object_index, trials.hand_index, trials.T_world_hand]
    decide += [] if trials.receiver is None else [trials.receiver]
    rows = ([row.tobytes() for row in x.cpu().numpy()] for x in decide)
    return [b"".join(parts) for parts in zip(*rows, strict=True)]


@KeptWith
def known_moments(scene: Scene) -> KnownMoments:
    """Those of a scene, for all its evaluators."""
    return KnownMoments(scene)
