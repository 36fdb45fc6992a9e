"""What drives the frame loop otherwise than frame by frame: running ahead, a hand at a window."""
