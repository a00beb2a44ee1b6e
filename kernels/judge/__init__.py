"""The criteria."""
