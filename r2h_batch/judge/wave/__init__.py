"""Stages of judging in waves: a GPU's forms (docs/gpu.md)."""
