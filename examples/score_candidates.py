"""Scores K candidates for each of N trials in one call, and takes the best one of each.  python examples/score_candidates.py"""

import time

from r2h_batch import Evaluator, load_benchmark, reward
from r2h_batch.methods.random import predict

N, K = 64, 16
benchmark = load_benchmark()
evaluator = Evaluator(benchmark, device="cpu")  # or "cuda"
trials = benchmark.trials(N // 2, splits=["S0", "S1"])
proposals = [predict(trials, evaluator.scene, seed=k) for k in range(K)]  # your generator stands here
T_obj_ee = proposals[0].T_obj_ee.new_empty(N, K, 4, 4)
T_world_ee = T_obj_ee.clone()
for k, p in enumerate(proposals):
    T_obj_ee[:, k], T_world_ee[:, k] = p.T_obj_ee, p.T_world_ee

start = time.perf_counter()
scores = evaluator.score(T_obj_ee, T_world_ee, trials, stages="pose")  # no path is searched: "all" judges the survivors
best = reward.best_of_k(reward.quality(scores), K)  # (N,) which of the K
passed = scores.by_trial(K).success.gather(1, best[:, None])
print(
    f"{N * K} candidates in {time.perf_counter() - start:.2f} s: {scores.success.float().mean():.1%} pass the pose stage,"
)
print(f"the best of {K} does in {passed.float().mean():.1%} of {N} trials")
