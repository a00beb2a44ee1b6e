"""Looking at trials in a browser, a notebook, films and strips (extra `view`); trials as files of
other programs."""
