"""Readers of mesh files that come from anywhere: every count is checked against the file before memory is taken."""
