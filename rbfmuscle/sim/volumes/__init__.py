"""Volumes of labels: read with their names and directions, and turned into smooth closed surfaces."""
