"""Grasps of other data sets and tools in our own ee frame."""
