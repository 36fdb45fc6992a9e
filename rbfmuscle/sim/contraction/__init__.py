"""Muscles that contract: their keys in a scene, activation along a motion, tendon, and the law of the fibres."""
