"""Joints: their kinds, functions and poses."""
