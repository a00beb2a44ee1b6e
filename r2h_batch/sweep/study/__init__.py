"""A run against a real robot, and the tests of the user study."""
