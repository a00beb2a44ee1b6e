"""Files: bounded reading (`read`), atomic writing (`write`), a disk cache (`cache`), lines on
stderr and in a log file (`log`)."""
