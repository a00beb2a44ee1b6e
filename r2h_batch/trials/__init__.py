"""Which object goes to which hand, and where it stands."""
