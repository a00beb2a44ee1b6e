"""Joins the Ray cluster at an address and leaves it: a program for `cluster.reach` to end."""

import logging
import sys

import ray

if __name__ == "__main__":
    ray.init(address=sys.argv[1], log_to_driver=False, logging_level=logging.ERROR)
    ray.shutdown()
