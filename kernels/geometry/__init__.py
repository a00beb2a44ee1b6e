"""Bodies, GJK, surfaces: distances between shapes."""
