"""Negatives from the optimiser: the pairs that a network likes best, judged, as items of the stream."""

from collections.abc import Mapping

import torch
from torch import Tensor

from r2h_batch.base import rng
from r2h_batch.base.validate import check_arguments, instance_of, integer, optional
from r2h_batch.methods.ranker.search import Score, liked
from r2h_batch.training.pairs import Pairs
from r2h_batch.types import Trials


class Mined(Pairs):
    """A stream whose pairs are those that `score` likes best (`mine` makes one); else as `Pairs`."""

    def __init__(
        self, pairs: Pairs, score: Score, *, first: int, second: int, top: int,
        first_item: int, items: int | None,
    ) -> None:  # fmt: skip
        """As `mine`.

        Args:
            pairs: whose trials they are.
            score: ranks pairs.
            first: pairs tried at random.
            second: pairs tried near the best.
            top: how many count as the best.
            first_item: number of the first item.
            items: number of items.
        """
        self.__dict__.update(vars(pairs))
        self.first_item, self.items, self.left_out = first_item, items, None
        self._score, self._tries = score, {"first": first, "second": second, "top": top}
        self._search = rng.key_of(f"mined {pairs.seed}")

    def chosen(
        self, trials: Trials, seen: Mapping[str, Tensor], middle: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The best pairs of both rounds, half of each; without a second round all are of the first.

        Args:
            trials: N trials.
            seen: what methods see of them.
            middle: (N, 3) what is brought to the palm, frame obj.
        """
        pick, T, good = liked(
            seen, middle, trials.trial_id, self._score, self._search, **self._tries
        )
        first, second = self._tries["first"], self._tries["second"]
        late = min(self.pairs // 2, second)
        best = good[:, :first].topk(self.pairs - late, dim=1).indices
        if late:
            best = torch.cat([best, first + good[:, first:].topk(late, dim=1).indices], 1)
        rows = torch.arange(len(pick), dtype=torch.int64, device="cpu")[:, None]
        return pick[rows, best], T[rows, best]


@check_arguments(
    pairs=instance_of(Pairs, "what r2h_batch.training.stream returns"),
    first=integer(1),
    second=integer(0),
    top=integer(1),
    first_item=integer(0),
    items=optional(integer(1)),
)
def mine(
    pairs: Pairs,
    score: Score,
    *,
    first: int = 384,
    second: int = 192,
    top: int = 8,
    first_item: int = 0,
    items: int | None = None,
) -> Mined:
    """The pairs that a network likes best, judged: where it is wrong, it learns most.

    Each trial tries `first` pairs at random and `second` near the best `top` of them. The best of both rounds become the
    item's pairs, half of each.

    Args:
        pairs: a stream; its trials, instances and number of pairs.
        score: `(seen, pick, T_obj_ee, T_world_ee) -> (N, K)`, the larger the better. `seen` is an item without pairs and
            labels, `pick` (N, K) counts its candidates.
        first: pairs tried at random, at least as many as an item's pairs.
        second: pairs tried near the best, within 2 cm and 0.25 rad in each direction; 0: none.
        top: how many count as the best.
        first_item: number of the first item.
        items: number of items; None: no end.

    Raises:
        ValueError: fewer pairs are tried than an item holds.
    """
    if first < pairs.pairs:
        raise ValueError(
            f"first is {first}; an item holds {pairs.pairs} pairs, try at least as many"
        )
    return Mined(
        pairs, score, first=first, second=second, top=top, first_item=first_item, items=items
    )
