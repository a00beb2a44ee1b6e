"""A stored trial as a laboratory needs it: paths for the arm, sheets for object and hand, a table to fill in."""
