"""Methods paired on the trials that they share.

`common_trials` (report/statistics/common.py) decides whether runs may be compared: same protocol,
digests (runs/provenance.py has the code's) and configuration.
"""
