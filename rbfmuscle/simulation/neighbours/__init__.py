"""Sliding of neighbouring muscles."""
