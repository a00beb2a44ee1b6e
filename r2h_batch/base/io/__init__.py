"""Files: bounded reading (`read`), atomic writing (`write`), and a disk cache (`cache`)."""
