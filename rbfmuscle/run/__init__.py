"""A run as data, its folder and the files in it."""
