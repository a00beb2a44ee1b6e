"""The time law and the queue of worlds."""
