"""Other people's data, one file per source. Nothing imports it but the command and the reading of a
benchmark."""
