"""Cameras: rays on the meshes of a scene, errors of the sensor."""
