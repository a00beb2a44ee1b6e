"""Episodes of a batch of handovers: a policy, receivers that move, and how they end."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from typing import Any

import torch

from r2h_batch.base.errors import AnswerError, EndedError, UsageError
from r2h_batch.base.user_code import chosen, raised
from r2h_batch.closed_loop.env import End, Episodes, HandoverEnv, LoopConfig
from r2h_batch.closed_loop.moving import KINDS, ReceiverMotion
from r2h_batch.closed_loop.policies import POLICIES, kind_of_action
from r2h_batch.runs import provenance
from r2h_batch.strangers import Ended, stranger
from r2h_batch.trials.benchmark import Benchmark
from r2h_batch.types import Scores

__all__ = ["Loop", "play", "policy_of"]

AT_ONCE = 256
"""Episodes that run together."""


def policy_of(spec: str) -> tuple[Any, str]:
    """A policy by its name, or the user's, and a text that says what decides its actions.

    Args:
        spec: a name of `POLICIES`, `package.module:function` or `FILE.py:function`.

    Raises:
        ImportError: the module or function does not exist.
        TypeError: it cannot be called.
    """
    policy, own = chosen(POLICIES, spec)
    if own is None:
        return policy, spec
    if not callable(policy):
        raise TypeError(f"{spec} is not a function")
    return policy, f"{own.spec} {provenance.file_digest(own.files().values())[:16]}"


def check_in_gripper(benchmark: Benchmark) -> None:
    """That a sweep can play episodes on a benchmark: those of stored runs begin at home with the object in the gripper.

    Args:
        benchmark: whose trials are to be played.

    Raises:
        UsageError: its trials begin with the object on the table.
    """
    if "pick" in benchmark.asks:
        raise UsageError(
            f"a sweep's closed loop begins with the object in the gripper, and trials of {benchmark.name} begin on the table;"
            " take r2h-v2, or gymnasium.make_vec('r2h_batch/Handover-v3'), whose episodes begin where the object is lifted"
        )


def play(env: HandoverEnv, policy: Callable[..., Any], name: str = "policy") -> Episodes:
    """Runs all episodes to their ends.

    Args:
        env: whose action is what the policy says (`kind_of_action`).
        policy: a function of an observation, or a class that is made with the environment first.
        name: of the policy, for messages.

    Raises:
        AnswerError: the policy raised an error, or its answer is no action.
    """
    observation = env.begin()
    act = policy
    if isinstance(policy, type):
        with _answering(name, policy):
            act = policy(env)
    while bool((env.ends == int(End.RUNNING)).any()):
        with _answering(name, policy):
            actions = env.checked_actions(act(observation))
        observation, *_ = env.advance(actions)
    return env.episodes()


@contextmanager
def _answering(name: str, policy: Callable[..., Any]) -> Iterator[None]:
    """One line about whatever a policy's code raises."""
    try:
        with stranger(f"policy {name}", getattr(policy, "__module__", "") or ""):
            yield
    except (KeyboardInterrupt, AnswerError):
        raise
    except BaseException as error:  # SystemExit too
        kind = EndedError if isinstance(error, Ended) else AnswerError
        raise kind(f"policy {name}: {raised(error)}") from error


@dataclass(frozen=True)
class Loop:
    """How a sweep's handovers are played in closed loop."""

    motion: ReceiverMotion
    policy: str
    config: LoopConfig

    @property
    def identity(self) -> str:
        """Text for run folders that names all settings which decide the episodes."""
        m, c = asdict(self.motion), asdict(self.config)
        if self.motion.file:
            m["file"] = provenance.file_digest([self.motion.path])[:16]
        fields = [f"{k} {v}" for k, v in {**m, **c}.items() if v != ""]
        return f"{policy_of(self.policy)[1]}; {', '.join(fields)}"

    @staticmethod
    def of(identity: str) -> "Loop":
        """The loop with that identity.

        Args:
            identity: the text that `Loop.identity` gives.

        Raises:
            ValueError: it cannot be made from the text alone: the policy is not built in, the motion was imported,
                or no loop says so of itself.
        """
        policy, _, rest = identity.partition("; ")
        fields = dict(part.partition(" ")[::2] for part in rest.split(", "))
        if policy not in POLICIES:
            raise ValueError(f"policy {policy.split(' ')[0]} is not built in")
        if fields.get("kind") == "replay":
            raise ValueError("the imported motion is not in the folder")
        try:
            seed, rate_hz = int(fields.pop("seed")), int(fields.pop("rate_hz"))
            motion = ReceiverMotion(
                fields.pop("kind"),
                float(fields.pop("shift_m")),
                float(fields.pop("turn_deg")),
                seed=seed,
            )
            config = LoopConfig(rate_hz, seed=seed, **{k: float(v) for k, v in fields.items()})
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"no closed loop is {identity[:200]!r} ({error})") from None
        loop = Loop(motion, policy, config)
        if motion.kind not in KINDS or loop.identity != identity:
            raise ValueError(f"no closed loop is {identity[:200]!r}")
        return loop

    def __call__(self, scores: Scores) -> Episodes:
        policy, _ = policy_of(self.policy)
        parts = []
        for i in range(0, len(scores), AT_ONCE):
            part = scores[i : i + AT_ONCE]
            env = HandoverEnv(
                part,
                self.motion,
                config=self.config,
                action=kind_of_action(policy),  # type: ignore[arg-type]
            )
            parts.append(play(env, policy, self.policy))
        return Episodes(
            **{
                f.name: torch.cat([getattr(p, f.name) for p in parts]).cpu()
                for f in fields(Episodes)
            }
        )
