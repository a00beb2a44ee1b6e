"""What the methods need."""
