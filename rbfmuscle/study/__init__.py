"""Measures and shows; changes nothing."""
