"""Warp kernels and functions. They know Warp only: no torch, no configuration, no allocation, no files.

What depends on the arm's number of joints imports `robot/joints.py` or another such file, relatively: imported once more as
another package (r2h_batch.base.launch.instances) the same files are kernels for another number.
"""

JOINTS = 6
