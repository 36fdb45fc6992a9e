"""Signed distance to a bone, in any pose."""
