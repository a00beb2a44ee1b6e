"""Joint angles of a pose."""
