"""Muscle fibres as lines: traced at rest, carried by the material, measured."""
