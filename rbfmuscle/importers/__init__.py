"""Scenes from OpenSim models, meshes and label volumes."""
