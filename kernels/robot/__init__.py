"""Kinematics, the gripper's linkage, everything at its place."""
