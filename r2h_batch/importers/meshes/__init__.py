"""Other people's objects as a folder that `--objects` takes."""
