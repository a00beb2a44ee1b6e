"""Warp kernels and functions. They know Warp only: no torch, no configuration, no allocation, no files."""
