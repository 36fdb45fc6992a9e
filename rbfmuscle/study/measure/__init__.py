"""What is measured of a frame or a run."""
