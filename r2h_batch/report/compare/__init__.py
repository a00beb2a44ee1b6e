"""Methods paired on the trials that they share.

`common_trials` (report/statistics/common.py) decides whether runs may be compared: the same robot,
protocol, numbers of trials (or trials that follow from the protocol), digests (runs/provenance.py has the code's) and
configuration. Versions of packages, device, seed of a method and predictors are not compared.
"""
