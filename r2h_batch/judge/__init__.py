"""Grasp, IK, plan, goal, criteria: one stage, one file."""
