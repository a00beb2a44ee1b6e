"""Grasp, IK, plan, goal, criteria: one stage, one file. presented, reception and payload measure what is
no part of the verdict."""
