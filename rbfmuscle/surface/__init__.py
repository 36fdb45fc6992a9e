"""The surface of an RBF muscle in motion: its field, bones, and crossings of itself."""
