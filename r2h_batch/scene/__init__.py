"""Bodies as tables on a device, and as one MuJoCo model."""
