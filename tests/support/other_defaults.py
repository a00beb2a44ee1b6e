"""`python other_defaults.py DTYPE DEVICE FILE`: one of everything in a program whose torch makes other tensors by default.

DTYPE float32, float64, bfloat16; DEVICE cpu, or meta, which fails whatever touches it. The bytes of all that is returned
go to FILE, to be compared with a plain program's.
"""

import sys
from dataclasses import fields

import numpy as np
import torch

from r2h_batch import load_benchmark


def everything() -> dict[str, np.ndarray]:
    """Trials, scores of every kind, gradients, rewards, and every method's answers."""
    from importlib import import_module

    from r2h_batch import Evaluator, reward
    from r2h_batch.base.registry import METHOD_NAMES
    from r2h_batch.base.twist import exp, log
    from r2h_batch.methods.predictors import PredictorNoise

    trials = load_benchmark("r2h-v1").trials(1, splits=("S0", "S1"))
    evaluator = Evaluator(load_benchmark("r2h-v1"), device="cpu", threads=1)
    out = dict(vars(trials))
    answers = {}
    for name in METHOD_NAMES:
        function = import_module(f"r2h_batch.methods.{name.replace('-', '_')}").predict
        names = function.__code__.co_varnames
        given = {"evaluator": evaluator, "noise": PredictorNoise()}
        more = {k: v for k, v in given.items() if k in names}
        answers[name] = function(trials, evaluator.scene, seed=3, **more)
        out |= {f"{name} {k}": getattr(answers[name], k) for k in ("T_obj_ee", "T_world_ee")}
    poses = [answers["oracle"].T_obj_ee, answers["contact"].T_world_ee]
    moving = [T.clone().requires_grad_() for T in poses]
    near = [T.clone() for T in moving]
    for name, scores in {
        "all": evaluator.score(*poses, trials, keep_motion=True),
        "pose": evaluator.score(*near, trials, "pose"),
    }.items():
        out |= {f"{name} {f.name}": getattr(scores, f.name) for f in fields(scores) if f.name != "t_plan_s"}
        out |= {f"{name} {k}": getattr(reward, k)(scores) for k in ("quality", "success", "margin_vector")}
        out |= {f"{name} rank": reward.rank_of_k(reward.quality(scores), 2)}
        if name == "pose":
            scores.soft(temperature_m=0.01).sum().backward()
    out |= {f"gradient {i}": T.grad for i, T in enumerate(moving)}
    out["twist"] = log(exp(torch.full((2, 6), 0.3, dtype=torch.float32, device="cpu")))
    return {k: np.atleast_1d(v.detach().numpy()) for k, v in out.items() if isinstance(v, torch.Tensor)}


if __name__ == "__main__":
    torch.set_default_dtype(getattr(torch, sys.argv[1]))
    torch.set_default_device(sys.argv[2])
    np.savez(sys.argv[3], **everything())
