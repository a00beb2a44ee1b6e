"""A trial as MJCF, pictures, files for methods."""
