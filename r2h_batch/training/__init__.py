"""Gradients, rewards, torch.compile, captured calls."""
