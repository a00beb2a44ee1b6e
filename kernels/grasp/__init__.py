"""Closing the gripper on an object."""
