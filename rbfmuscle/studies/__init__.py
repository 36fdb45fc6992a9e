"""Studies: models, settings and kernels compared; each its computation, its table and its page."""
