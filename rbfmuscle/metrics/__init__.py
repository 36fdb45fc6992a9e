"""Quantities measured from frames."""
