"""What a method learns from: labelled pairs of new instances."""
