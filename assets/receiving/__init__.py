"""Receiving grasps and their build script."""
