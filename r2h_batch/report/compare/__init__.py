"""Methods paired on the trials that they share."""
