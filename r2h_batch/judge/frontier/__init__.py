"""Stages of judging level by level: a GPU's forms (docs/gpu.md)."""
