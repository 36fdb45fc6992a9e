"""Surfaces from label volumes."""
