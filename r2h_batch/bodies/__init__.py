"""Robot, hand, object: loaded numbers and meshes, and bounds on them."""
