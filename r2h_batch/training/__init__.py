"""Gradients, torch.compile, captured calls."""
