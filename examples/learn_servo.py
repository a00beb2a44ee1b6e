"""Cross-entropy method on a servo's three numbers: how near it slows down, how near it stands, how fast it follows the hand.

python examples/learn_servo.py          # minutes on two cores; needs the extra env

Every candidate plays the same training trials with the same hands and noise (draws are keyed by trial), all in one batch. What
was learned is then played on trials that nobody has seen.
"""

import argparse
import time

import torch

from r2h_batch import Evaluator, load_benchmark
from r2h_batch.closed_loop import End, Episodes, HandoverEnv, LoopConfig, Servo, play
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.methods.oracle import predict
from r2h_batch.types import Scores

NAMES = ("slow_m", "stop_m", "follow")
LOW, HIGH = torch.tensor([0.03, 0.005, 0.02]), torch.tensor([0.25, 0.03, 0.6])
CAUTIOUS = torch.tensor([0.22, 0.028, 0.04])
"""Where it begins."""
A_SECOND = 0.03
"""Cost of a second, as a share of a success."""


def returns(episodes: Episodes) -> torch.Tensor:
    """A success is worth 1 less its time, a contact or a collision -1, anything else 0."""
    end = episodes.end
    won, hurt = end == int(End.SUCCESS), (end == int(End.CONTACT)) | (end == int(End.COLLISION))
    return torch.where(won, 1.0 - A_SECOND * episodes.time_s, -hurt.float())


def played(scores: Scores, numbers: torch.Tensor) -> Episodes:
    """Episodes of every candidate (P, 3) on every row, candidate by candidate."""
    n = len(scores)
    env = HandoverEnv(
        scores[torch.arange(n).repeat(len(numbers))],
        "moves",
        config=LoopConfig(rate_hz=10, horizon_s=12),
        action="posture",
    )
    env.reset()
    own = dict(zip(NAMES, numbers.double().repeat_interleave(n, 0).unbind(1)))
    return play(env, Servo(env, **own))


def main(argv: list[str] | None = None) -> dict[str, float]:
    """Mean returns on unseen trials, before and after, and success rates."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=24, help="to learn from, and as many again to test")
    parser.add_argument("--population", type=int, default=12)
    parser.add_argument("--generations", type=int, default=6)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(argv)
    begin, random = time.perf_counter(), torch.Generator().manual_seed(options.seed)
    evaluator = Evaluator(load_benchmark("r2h-v1"), EvalConfig(execute=ExecConfig(sim="none")))
    trials = load_benchmark("r2h-v1").trials(options.trials)  # half of both splits to learn, half to test
    answer = predict(trials, evaluator.scene, evaluator=evaluator)
    scores = evaluator.score(answer.T_obj_ee, answer.T_world_ee, trials)
    half = torch.arange(len(scores)) % 2 == 0
    known, unseen = scores[half], scores[~half]

    first = CAUTIOUS
    mean, sd = first.clone(), 0.3 * (HIGH - LOW)
    for generation in range(options.generations):
        drawn = mean + sd * torch.randn(options.population, 3, generator=random)
        drawn = torch.minimum(torch.maximum(drawn, LOW), HIGH)
        drawn[0] = mean
        value = returns(played(known, drawn)).view(options.population, -1).mean(1)
        best = drawn[value.argsort(descending=True)[: max(2, options.population // 4)]]
        mean, sd = best.mean(0), best.std(0) + 0.02 * (HIGH - LOW)
        said = ", ".join(f"{name} {x:.3f}" for name, x in zip(NAMES, mean.tolist()))
        print(f"generation {generation}: best {value.max():.3f}, mean {value.mean():.3f}; {said}", flush=True)
    found = {}
    for name, numbers in (("before", first), ("after", mean)):
        episodes = played(unseen, numbers[None])
        found[f"return {name}"] = float(returns(episodes).mean())
        found[f"success {name}"] = float((episodes.end == int(End.SUCCESS)).float().mean())
    words = ", ".join(f"{name} {x:.3f}" for name, x in found.items())
    print(f"{len(unseen)} unseen trials: {words} ({time.perf_counter() - begin:.0f} s)")
    return found


if __name__ == "__main__":
    main()
