"""Handovers in closed loop: receivers who move, robots that look, and what came of it."""
