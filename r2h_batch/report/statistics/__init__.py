"""Rates, intervals, paired tests, other thresholds."""
