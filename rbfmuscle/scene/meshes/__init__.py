"""Meshes as files have them, read and mended."""
