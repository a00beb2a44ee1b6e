"""Other ways to call an evaluator: captured as a CUDA graph, inside torch.compile, with gradients."""
