"""Mesh-based PBD muscles: the baseline that RBF muscles are compared with."""
