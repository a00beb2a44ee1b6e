"""Committed data of the scene and the scripts that build it. SOURCES.md names what every file is made from."""
