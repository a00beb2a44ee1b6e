"""Robot, hand and object: loaded, bounded, as tables on a device and as one MuJoCo model."""
