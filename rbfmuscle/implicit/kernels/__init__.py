"""The radial kernels: their facts, and the loops that evaluate them."""
