"""Learns from the stream of labelled pairs with spawned DataLoader workers: python examples/spawned_stream.py

A spawned worker starts with nothing of the parent: it needs the guard `if __name__ == "__main__"`, and builds the judge's tables
once, which takes seconds. So the workers stay (`persistent_workers`), and each epoch takes other items.
"""

import argparse

import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader

from r2h_batch import load_benchmark
from r2h_batch.training import stream


def features(item: dict[str, Tensor]) -> Tensor:
    """(trials, pairs, 15) the handover pose in numbers, and where the hand's ball is."""
    pose = item["T_world_ee"][..., :3, :].flatten(2)
    return torch.cat([pose, item["ball_center"][:, None].expand(-1, pose.shape[1], 3)], -1)


def main(argv: list[str] | None = None) -> list[float]:
    """Mean loss of each item."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--families", default="* x 2 seed 5", help="instances that it learns from")
    parser.add_argument("--items", type=int, default=16, help="256 trials with 16 pairs each")
    parser.add_argument("--workers", type=int, default=2)
    args = parser.parse_args(argv)
    torch.manual_seed(0)
    pairs = stream(load_benchmark(), args.families, items=args.items, seed=0)
    loader = DataLoader(
        pairs, batch_size=None, num_workers=args.workers, multiprocessing_context="spawn", persistent_workers=True
    )
    # five criteria
    network = nn.Sequential(nn.Linear(15, 64), nn.SiLU(), nn.Linear(64, 5))
    adam = torch.optim.Adam(network.parameters(), lr=1e-3)
    losses: list[float] = []
    for item in loader:
        logit, label = network(features(item)), item["labels"]
        known = ~label.isnan()  # a criterion that was not evaluated, such as Affordance in S0
        loss = nn.functional.binary_cross_entropy_with_logits(logit[known], label[known])
        adam.zero_grad()
        loss.backward()
        adam.step()
        losses.append(loss.item())
    print(f"{len(losses)} items from {args.workers} spawned workers: loss {losses[0]:.3f}, then {losses[-1]:.3f}")
    return losses


if __name__ == "__main__":
    main()
