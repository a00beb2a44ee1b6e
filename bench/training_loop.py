"""How many candidates per second does Evaluator.score(stages="pose") judge inside a training loop, and at what cost?

python bench/training_loop.py [--device cpu|cuda:0] [--largest N] [--peer N] [--json FILE]

Candidates: the frozen mix of bench/throughput.py (bench/mix.npz: 1,024 trials of r2h-v0, half with the oracle's poses, half
with random ones), repeated; `perturbed`: the oracle's half moved by 1 cm (grasp), 3 cm and 10 degrees (handover), normal
distributions, as a generator in training proposes them; `distinct`: 4,096 of the mix, each moved by 1 mm of its own.
Figures of a size come from one call after another, the median of several; core_us is process time (other work on the machine
counts little), its smallest, and candidates_per_2_core_s what two cores would do at that price with nothing else to do.
On CUDA there is one kind of time: wall, synchronised.
training: one step of a small generator (three layers of 256, Adam) on 4,096 candidates, scored each step. The peer judges the
same candidates one by one with MuJoCo C, trimesh, FCL and ur-analytic-ik (bench/_pose_peer.py; building its MuJoCo model is
not counted). memory: resident kB (CUDA: allocated) around 1,000 calls.
"""

import ctypes
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _mix import Poses, load_mix, on, repeated
from _report import Report, arguments

from r2h_batch import launch, reward
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.types import CRITERIA, Outcome, PlanReason

SIZES = (1, 64, 4096, 65536)


class Clock:
    """Wall and core time; on CUDA the device is waited for."""

    def __init__(self, device: str) -> None:
        self.cuda = device != "cpu"

    def now(self) -> tuple[float, float]:
        if self.cuda:
            torch.cuda.synchronize()
        return time.perf_counter(), time.perf_counter() if self.cuda else time.process_time()

    def of(self, run: Callable[[], Any], repeats: int) -> tuple[float, float, float]:
        """Median wall, least wall and least core seconds of a call, after one to warm up."""
        run()
        times = []
        for _ in range(repeats):
            a = self.now()
            run()
            b = self.now()
            times.append((b[0] - a[0], b[1] - a[1]))
        wall, core = zip(*times, strict=True)
        return statistics.median(wall), min(wall), min(core)


def candidates(evaluator: Evaluator, name: str) -> Poses:
    """The 1,024 (perturbed: 512) candidates of a mix."""
    mix, by_oracle = load_mix(evaluator.scene)
    if name == "mix":
        return mix
    device, g = str(evaluator.scene.device), torch.Generator().manual_seed(0)
    g_all, h_all, all_trials = on(mix, "cpu")
    T_obj_ee, T_world_ee, trials = g_all[by_oracle], h_all[by_oracle], all_trials[by_oracle]
    n = len(trials)
    T_obj_ee[:, :3, 3] += 0.01 * torch.randn(n, 3, generator=g)
    T_world_ee[:, :3, 3] += 0.03 * torch.randn(n, 3, generator=g)
    turn = torch.linalg.matrix_exp(np.radians(10) * _skew(torch.randn(n, 3, generator=g)))
    T_world_ee[:, :3, :3] = turn @ T_world_ee[:, :3, :3]
    return on((T_obj_ee, T_world_ee, trials), device)


def _skew(w: torch.Tensor) -> torch.Tensor:
    x, y, z = w.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], -1).view(-1, 3, 3)


def distinct(c: Poses) -> Poses:
    """The same candidates, no two of them alike: repeated rows could be cheaper than what anybody asks for."""
    T_obj_ee, T_world_ee, g = c[0].clone(), c[1].clone(), torch.Generator().manual_seed(0)
    for T in (T_obj_ee, T_world_ee):
        T[:, :3, 3] += 0.001 * torch.randn(len(T), 3, generator=g).to(T.device)
    return T_obj_ee, T_world_ee, c[2]


def sizes(report: Report, evaluator: Evaluator, mix: Poses, clock: Clock, largest: int) -> None:
    for b in sorted({*(s for s in SIZES if s <= largest), largest}):
        c = repeated(mix, b)
        repeats = 30 if b < 1000 else 5 if b < 10000 else 2
        median, best, core = clock.of(lambda c=c: evaluator.score(*c, stages="pose"), repeats)  # type: ignore[misc]
        name = f"training_loop.pose.b{b}"
        report.add(f"{name}.candidates_per_s", b / median)
        report.add(f"{name}.candidates_per_s_best", b / best)
        report.add(f"{name}.core_us_per_candidate", 1e6 * core / b)
        report.add(f"{name}.candidates_per_2_core_s", 2 * b / core)
    for b in (1, 64):
        captured, c = evaluator.capture(b), repeated(mix, b)
        _, best, _ = clock.of(lambda captured=captured, c=c: captured(*c), 30)  # type: ignore[misc]
        report.add(f"training_loop.captured.b{b}.ms", 1e3 * best)


class Generator(torch.nn.Module):
    """(g, h) from noise and the hand's pose: what a small policy costs beside its reward."""

    def __init__(self) -> None:
        super().__init__()
        self.net = torch.nn.Sequential(
            torch.nn.Linear(32, 256), torch.nn.SiLU(), torch.nn.Linear(256, 256), torch.nn.SiLU(),
            torch.nn.Linear(256, 256), torch.nn.SiLU(), torch.nn.Linear(256, 12),
        )  # fmt: skip

    def forward(self, T_world_hand: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        return self.net(torch.cat([T_world_hand.flatten(1), noise], 1))


def training(report: Report, evaluator: Evaluator, mix: Poses, clock: Clock, b: int) -> None:
    """Share of a step that the reward takes: score-function gradient on translations around the candidates."""
    T_obj_ee, T_world_ee, trials = repeated(mix, b)
    generator = Generator().to(T_obj_ee.device)
    optimiser = torch.optim.Adam(generator.parameters(), 1e-3)
    spent = [0.0]

    def step() -> None:
        optimiser.zero_grad()
        mean = generator(trials.T_world_hand, torch.randn(b, 16, device=T_obj_ee.device))
        sample = (mean + 0.05 * torch.randn_like(mean)).detach()
        g, h = T_obj_ee.clone(), T_world_ee.clone()
        g[:, :3, 3] += 0.05 * sample[:, :3]
        h[:, :3, 3] += 0.1 * sample[:, 3:6]
        start = clock.now()[1]
        value = reward.quality(evaluator.score(g, h, trials, stages="pose"))
        spent[0] += clock.now()[1] - start
        loss = (((sample - mean) / 0.05).square().sum(1) * (value - value.mean())).mean()
        loss.backward()
        optimiser.step()

    step()
    spent[0], start = 0.0, clock.now()[1]
    for _ in range(3):
        step()
    total = clock.now()[1] - start
    report.add("training_loop.training.step_ms", 1e3 * total / 3)
    report.add("training_loop.training.share_of_scoring", spent[0] / total)


def memory(report: Report, evaluator: Evaluator, mix: Poses, clock: Clock) -> None:
    """Growth over 1,000 calls, and the peak that a candidate of a large call adds."""

    def used_kb() -> float:
        if clock.cuda:
            return torch.cuda.memory_reserved() / 1024
        with open("/proc/self/statm") as f:
            return int(f.read().split()[1]) * resource.getpagesize() / 1024

    c = repeated(mix, 64)
    for _ in range(300):
        evaluator.score(*c, stages="pose")
    before = used_kb()
    for _ in range(1000):
        evaluator.score(*c, stages="pose")
    report.add("training_loop.memory.growth_kb_over_1000_calls", used_kb() - before)
    b = 8192
    if clock.cuda:
        torch.cuda.reset_peak_memory_stats()
        start = torch.cuda.memory_allocated()
        evaluator.score(*repeated(mix, b), stages="pose")
        peak = (torch.cuda.max_memory_allocated() - start) / 1024
    else:  # a process of its own: this one has been larger before
        command = [sys.executable, __file__, "--peak-of", str(b)]
        peak = float(subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()[-1])
    report.add("training_loop.memory.peak_kb_per_candidate", peak / b)


def print_peak(evaluator: Evaluator, mix: Poses, b: int) -> None:
    """How much resident memory (kB) rises at most in one call of size b, after a small one."""
    evaluator.score(*mix, stages="pose")
    c = repeated(mix, b)
    ctypes.CDLL("libc.so.6").malloc_trim(0)  # memory that was used before and kept would hide what a call needs
    Path("/proc/self/clear_refs").write_text("5")  # forgets the peak so far
    before = float(Path("/proc/self/status").read_text().split("VmRSS:")[1].split()[0])
    scores = evaluator.score(*c, stages="pose")
    peak = float(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0])
    print(peak - before if len(scores) == b else "failed")


def peer(report: Report, evaluator: Evaluator, mix: Poses, n: int) -> None:
    """The same candidates one by one; where its verdicts differ although ours are not borderline, by criterion."""
    from _pose_peer import PosePeer

    g, h, trials = mix[0].cpu(), mix[1].cpu(), mix[2].to("cpu")
    rows = torch.from_numpy(np.random.default_rng(1).permutation(len(trials))[:n])
    g, h, trials = g[rows], h[rows], trials[rows]
    scene, spent, differ = evaluator.scene, 0.0, dict.fromkeys(CRITERIA, 0)
    ours = evaluator.score(g.to(scene.device), h.to(scene.device), trials.to(scene.device), stages="pose").to("cpu")
    _, _, ball = scene.palm(trials.hand_index.to(scene.device), trials.T_world_hand.to(scene.device))
    one_by_one = PosePeer(scene)
    for i in range(n):
        o, hand = int(trials.object_index[i]), int(trials.hand_index[i])
        T_obj_ee, T_world_ee, T_world_hand = (x[i].double().numpy() for x in (g, h, trials.T_world_hand))
        middle = ball[i].cpu().double().numpy()
        checker = one_by_one.build(o, hand, T_obj_ee, T_world_hand)
        start = time.process_time()
        verdict = one_by_one.judge(checker, o, hand, T_obj_ee, T_world_ee, T_world_hand, middle)
        spent += time.process_time() - start
        for k, name in enumerate(CRITERIA):
            both = verdict[k] is not None and bool(ours.evaluated[i, k]) and (k < 4 or bool(ours.passed[i, 1]))
            differ[name] += both and verdict[k] != bool(ours.passed[i, k]) and abs(float(ours.margin[i, k])) > 1e-3
    core = report.values["training_loop.pose.b4096.core_us_per_candidate"]
    report.add("training_loop.peer.candidates", n)
    report.add("training_loop.peer.candidates_per_core_s", n / spent)
    report.add("training_loop.peer.slower_by", 1e6 * spent / n / float(core))
    for name, count in differ.items():
        report.add(f"training_loop.peer.differs_beyond_1mm.{name}", int(count))


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--largest", type=int, default=None, help="largest batch (default: 65,536; 1,048,576 on CUDA)")
    parser.add_argument("--peer", type=int, default=64, help="candidates for the peer (0: none)")
    parser.add_argument("--threads", type=int, default=None, help="CPU threads (default: one per core)")
    parser.add_argument("--peak-of", type=int, default=None, help="print the peak memory (kB) of one call of this size")
    options = parser.parse_args()
    report, clock = Report(), Clock(options.device)
    largest = options.largest or (65536 if options.device == "cpu" else 1 << 20)
    evaluator = Evaluator(EvalConfig(execute=ExecConfig(sim="none")), device=options.device, threads=options.threads)
    mix = candidates(evaluator, "mix")
    if options.peak_of:
        print_peak(evaluator, mix, options.peak_of)
        return
    report.add("training_loop.threads", launch.cpu_threads(options.threads))

    sizes(report, evaluator, mix, clock, largest)
    near = repeated(candidates(evaluator, "perturbed"), 4096)
    for name, c in (("perturbed", near), ("distinct", distinct(repeated(mix, 4096)))):
        median, best, core = clock.of(lambda c=c: evaluator.score(*c, stages="pose"), 5)  # type: ignore[misc]
        report.add(f"training_loop.{name}.b4096.candidates_per_s", 4096 / median)
        report.add(f"training_loop.{name}.b4096.candidates_per_s_best", 4096 / best)
        report.add(f"training_loop.{name}.b4096.core_us_per_candidate", 1e6 * core / 4096)
    for name, c in (("mix", mix), ("perturbed", near)):
        s = evaluator.score(*c, stages="pose")
        report.add(f"training_loop.{name}.success", float(s.success.double().mean()))
        for reason in (PlanReason.OK, PlanReason.IK_UNREACHABLE, PlanReason.IK_IN_COLLISION):
            share = float((s.plan_reason == int(reason)).double().mean())
            report.add(f"training_loop.{name}.{reason.name.lower()}_share", share)
        report.add(
            f"training_loop.{name}.stability_failures", float((s.outcome == int(Outcome.STABILITY)).double().mean())
        )
    training(report, evaluator, mix, clock, 4096)
    memory(report, evaluator, mix, clock)
    if options.peer:
        peer(report, evaluator, mix, options.peer)
    report.write(options.json)


if __name__ == "__main__":
    main()
