"""PPO (Schulman et al. 2017) on a network that says at each step how near the built-in servo slows down and stands, and how
fast it follows the hand.

python examples/learn_ppo.py          # minutes on two cores; needs the extra env

The network begins as the servo itself: all its answers are 0, which are the servo's own numbers. It learns on new instances of
the families, with new hands and noise in each round. Then both play trials of the benchmark, whose objects the network has not
seen, with the same hands and noise. The program prints the difference with its interval. One file, torch alone, as CleanRL's
examples.
"""

import argparse
import json
import time
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from r2h_batch import Benchmark, Evaluator, load_benchmark
from r2h_batch.closed_loop import End, HandoverEnv, LoopConfig, Servo
from r2h_batch.closed_loop.policies import FOLLOW, SLOW_M, STOP_M
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.methods.oracle import predict
from r2h_batch.training import stream
from r2h_batch.types import Scores

BENCHMARK = "r2h-v2"
CONFIG = LoopConfig(rate_hz=10, horizon_s=12)
OWN = torch.tensor([SLOW_M, STOP_M, FOLLOW], dtype=torch.float64)
LOW, HIGH = torch.tensor([0.03, 0.004, 0.03]).double(), torch.tensor([0.25, 0.04, 0.6]).double()
GAMMA, LAMBDA, CLIP, EPOCHS, PIECES = 0.99, 0.95, 0.2, 4, 4


class Network(nn.Module):
    """Means of the three answers, and the value of a state."""

    def __init__(self) -> None:
        super().__init__()
        means = nn.Linear(48, 3)
        self.actor = nn.Sequential(nn.Linear(9, 48), nn.Tanh(), nn.Linear(48, 48), nn.Tanh(), means)
        self.critic = nn.Sequential(nn.Linear(9, 48), nn.Tanh(), nn.Linear(48, 48), nn.Tanh(), nn.Linear(48, 1))
        self.log_sd = nn.Parameter(torch.full((3,), -0.7))
        nn.init.zeros_(means.weight)
        nn.init.zeros_(means.bias)

    def forward(self, state: Tensor) -> tuple[torch.distributions.Normal, Tensor]:
        return torch.distributions.Normal(self.actor(state), self.log_sd.exp()), self.critic(state)[..., 0]


def numbers_of(answer: Tensor) -> Tensor:
    """The servo's three numbers for answers (..., 3): its own at 0, at most three times larger or smaller at 1."""
    return torch.minimum(torch.maximum(OWN * 3.0 ** answer.double(), LOW), HIGH)


def state_of(seen: dict[str, Tensor], before: dict[str, Tensor], servo: Servo) -> Tensor:
    """Observations of B rows as (B, 9) numbers of about 1."""
    T, there = seen["T_world_ee"], seen["T_world_hand"] @ seen["T_hand_ee"]
    left, moved = (there - T)[:, :3, 3], (seen["T_world_hand"] - before["T_world_hand"])[:, :3, 3]
    come = (servo.clock / servo.end_s).float()
    turned = (there[:, :3, :3] * T[:, :3, :3]).sum((1, 2))
    columns = [seen["time"] / CONFIG.horizon_s, seen["gap"] * 8, come, come * seen["gap"] * 8, seen["age"] * 5]
    columns += [left.norm(dim=1) * 4, moved.norm(dim=1) * 20, turned / 3, seen["qd"].abs().amax(1) * 2]
    return torch.stack(columns, 1)


@dataclass
class Played:
    """Episodes of B rows in S steps, (S, B) or (S, B, 3)."""

    state: Tensor
    answer: Tensor
    log_p: Tensor
    value: Tensor
    reward: Tensor
    alive: Tensor


def play(env: HandoverEnv, network: Network | None, seen: dict[str, Tensor], *, explore: bool) -> Played:
    """All episodes to their ends; without a network the servo as it is."""
    servo, before, rows = Servo(env), seen, []
    while bool((alive := env.ends == int(End.RUNNING)).any()):
        state = state_of(seen, before, servo)
        answer, log_p, value = torch.zeros(len(state), 3), torch.zeros(len(state)), torch.zeros(len(state))
        if network is not None:
            with torch.no_grad():
                says, value = network(state)
            answer = says.sample() if explore else says.mean
            log_p = says.log_prob(answer).sum(1)
        servo.slow_m, servo.stop_m, servo.follow = numbers_of(answer).unbind(1)
        before = seen
        seen, reward, *_ = env.step(servo(seen))
        rows.append((state, answer, log_p, value, reward, alive))
    return Played(*(torch.stack(x) for x in zip(*rows, strict=True)))


def learn(network: Network, optimizer: torch.optim.Optimizer, p: Played) -> None:
    """One round of PPO: generalised advantages, then `EPOCHS` passes over the steps of running episodes."""
    alive, ahead, advantage = p.alive.float(), torch.zeros(p.value.shape[1]), torch.zeros_like(p.value)
    for t in reversed(range(len(p.value))):
        last = t + 1 == len(p.value)
        follows = torch.zeros_like(ahead) if last else alive[t + 1]
        value = torch.zeros_like(ahead) if last else p.value[t + 1]
        ahead = p.reward[t] + GAMMA * follows * value - p.value[t] + GAMMA * LAMBDA * follows * ahead
        advantage[t] = ahead
    own = p.alive
    state, answer, log_p, gain = p.state[own], p.answer[own], p.log_p[own], advantage[own]
    goal = gain + p.value[own]
    gain = (gain - gain.mean()) / (gain.std() + 1e-6)
    for _ in range(EPOCHS):
        for part in torch.randperm(len(state)).chunk(PIECES):
            says, value = network(state[part])
            ratio = (says.log_prob(answer[part]).sum(1) - log_p[part]).exp()
            clipped = ratio.clamp(1 - CLIP, 1 + CLIP)
            loss = -torch.minimum(ratio * gain[part], clipped * gain[part]).mean()
            loss = loss + 0.5 * (value - goal[part]).square().mean() - 1e-3 * says.entropy().sum(1).mean()
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(network.parameters(), 0.5)
            optimizer.step()


def compared(scores: Scores, network: Network, repeats: int) -> dict[str, float]:
    """The network and the servo on the same episodes: `repeats` of each row, with other hands and noise."""
    found: dict[str, list[np.ndarray]] = {}
    for name, one in (("servo", None), ("ppo", network)):
        env = HandoverEnv(scores, "moves", config=CONFIG, action="posture", output="torch")
        for k in range(repeats):
            played = play(env, one, env.reset(seed=1000 + k)[0], explore=False)
            won = (env.ends == int(End.SUCCESS)).numpy().astype(float)
            came = (played.reward * played.alive).sum(0).numpy()
            found.setdefault(name, []).append(np.stack([100 * won, came, env.episodes().time_s.numpy()]))
    servo, ppo = (np.stack(found[k]).mean(0) for k in ("servo", "ppo"))  # (3, rows): trials are the independent units
    more = ppo - servo
    half = 1.96 * more.std(1, ddof=1) / np.sqrt(more.shape[1])
    keys = ("success %", "return", "time s")
    out = {
        f"{key}, {name}": float(x[i].mean())
        for i, key in enumerate(keys)
        for name, x in (("servo", servo), ("ppo", ppo))
    }
    out |= {f"{key}, ppo - servo": float(more[i].mean()) for i, key in enumerate(keys)}
    return out | {f"{key}, half of the 95 % interval": float(half[i]) for i, key in enumerate(keys)}


def handed_over(benchmark: Benchmark, trial_id: Tensor) -> Scores:
    """The oracle's handovers in these trials, with their planned paths: what an episode begins with."""
    evaluator = Evaluator(benchmark, EvalConfig(execute=ExecConfig(sim="none")))
    trials = benchmark.trials_with_ids(trial_id)
    answer = predict(trials, evaluator.scene, evaluator=evaluator)
    return evaluator.score(answer.T_obj_ee, answer.T_world_ee, trials)


def main(argv: list[str] | None = None) -> dict[str, float]:
    """Success, return and time of servo and network on unseen trials, and their differences."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--families", default="* x 2 seed 5", help="instances that it learns from")
    parser.add_argument("--learn", type=int, default=64, help="trials of a round")
    parser.add_argument("--trials", type=int, default=96, help="unseen trials, of each split")
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--repeats", type=int, default=2, help="of each unseen trial")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(argv)
    begin = time.perf_counter(), time.process_time()
    torch.manual_seed(options.seed)
    benchmark = load_benchmark(BENCHMARK)
    pairs = stream(
        benchmark, options.families, pairs=1, trials=options.learn
    )  # new instances, trials that nobody is tested on
    known = handed_over(pairs.benchmark, pairs.item(0)["trial_id"])
    unseen = handed_over(benchmark, benchmark.trials(options.trials).trial_id)

    env = HandoverEnv(known, "moves", config=CONFIG, action="posture", output="torch")
    seen, _ = env.reset(seed=options.seed)
    network = Network()
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    for k in range(options.rounds):
        played = play(env, network, seen, explore=True)
        won = float((env.ends == int(End.SUCCESS)).float().mean())
        came = float((played.reward * played.alive).sum(0).mean())
        print(
            f"round {k}: success {100 * won:.0f} %, return {came:.3f}, {time.process_time() - begin[1]:.0f} CPU s",
            flush=True,
        )
        learn(network, optimizer, played)
        seen, _ = env.reset()
    found = compared(unseen, network, options.repeats)
    for key, value in found.items():
        print(f"{key}: {value:.3f}")
    wall, cpu = (now - then for now, then in zip((time.perf_counter(), time.process_time()), begin, strict=True))
    print(f"{len(unseen)} unseen trials, each {options.repeats} times; {wall:.0f} s, {cpu:.0f} CPU s")
    of = {"rounds": options.rounds, "learned": len(known), "instances": len(pairs.objects), "repeats": options.repeats}
    return found | of | {"unseen": len(unseen), "cpu s": cpu}


if __name__ == "__main__":
    print(json.dumps(main(), indent=1))
