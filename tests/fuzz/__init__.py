"""Hostile scenes and meshes, seeded: ``make fuzz``, and a small share of it in ``make test``."""
