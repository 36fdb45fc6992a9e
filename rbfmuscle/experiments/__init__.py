"""Kernel studies, comparisons and sweeps."""
