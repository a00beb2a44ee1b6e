"""Gradients and torch.compile."""
