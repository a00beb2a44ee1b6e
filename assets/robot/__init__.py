"""Data of the robot and its build script."""
