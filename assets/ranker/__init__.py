"""Weights of method `learned`, as `r2h-batch train rank` wrote them."""
