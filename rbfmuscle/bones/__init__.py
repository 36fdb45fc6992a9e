"""Signed distance fields of bones."""
