"""Stored rows checked, judged again and counted again.

reevaluation.py judges a stored row again: it reads the pose that is stored beside the row, and scores
it as a sweep does (`judged_tables`, which calls `Evaluator.score`).
"""
