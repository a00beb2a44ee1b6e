"""A trial as MJCF, as files for methods, as files of the authors' release."""
