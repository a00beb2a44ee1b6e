"""The shipped instances of the object families, and the script that builds them."""
