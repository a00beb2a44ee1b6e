"""Gradients, torch.compile, captured calls, calls that come back in one size."""
