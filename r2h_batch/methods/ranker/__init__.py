"""A network that ranks pairs (grasp candidate, handover pose): what it sees, its features, its weights, its search."""
