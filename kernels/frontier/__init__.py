"""The planner as a GPU runs it: stages over queues of intervals and of pairs, every one a small kernel (docs/gpu.md)."""
