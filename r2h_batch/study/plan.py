"""A within-subject schedule: every participant meets every method with the same objects, in a
balanced order."""

from collections.abc import Mapping, Sequence

import numpy as np

MAX_PARTICIPANTS = 100_000


def williams_square(n: int) -> np.ndarray:
    """Orders of n treatments: each stands in each place, and follows each other, equally often.

    Returns:
        (n, n) orders as rows if n is even, (2 n, n) if it is odd (Williams 1949).
    """
    first = np.array([(k + 1) // 2 if k % 2 else (n - k // 2) % n for k in range(n)])
    square = (first[None, :] + np.arange(n)[:, None]) % n
    return square if n % 2 == 0 else np.concatenate([square, square[:, ::-1]])


def schedule(
    participants: int,
    methods: Sequence[str],
    objects: Mapping[str, Sequence[str]],
    take: Mapping[str, int],
    *,
    seed: int,
) -> list[dict[str, str | int]]:
    """Draw the schedule.

    Objects are dealt so that all are used equally often, give or take one. A participant meets the
    same objects with every method, each time in a new random order.

    Args:
        participants: number of people.
        methods: two or more names.
        objects: split -> names.
        take: split -> objects for each participant.
        seed: of the shuffling.

    Returns:
        Rows of participant, place, method, trial, split, object.
    """
    if not 1 <= participants <= MAX_PARTICIPANTS:
        raise ValueError(f"--participants is {participants}; it must be 1 to {MAX_PARTICIPANTS}")
    if len(methods) < 2 or len(set(methods)) != len(methods):
        raise ValueError(
            f"--methods are {', '.join(methods) or 'none'}; give two or more different ones"
        )
    for split, n in take.items():
        if not 0 <= n <= len(objects[split]):
            raise ValueError(f"--{split.lower()} is {n}; {split} has {len(objects[split])} objects")
    if not sum(take.values()):
        raise ValueError("--s0 and --s1 are both 0; every participant needs an object")
    random = np.random.default_rng(seed)
    names = [methods[i] for i in random.permutation(len(methods))]
    square = williams_square(len(names))
    blocks = [random.permutation(len(square)) for _ in range(-(-participants // len(square)))]
    orders = square[np.concatenate(blocks)[:participants]]
    used = {split: np.zeros(len(objects[split]), int) for split in take}
    rows: list[dict[str, str | int]] = []
    for person, order in enumerate(orders, start=1):
        drawn = []
        for split, n in take.items():
            chosen = np.lexsort((random.random(len(used[split])), used[split]))[:n]
            used[split][chosen] += 1
            drawn += [(split, objects[split][i]) for i in chosen]
        for place, method in enumerate(order, start=1):
            for trial, k in enumerate(random.permutation(len(drawn)), start=1):
                split, name = drawn[k]
                who = {"participant": person, "place": place, "method": names[method]}
                rows.append({**who, "trial": trial, "split": split, "object": name})
    return rows
