"""Hostile scenes and meshes, seeded: ``make fuzz``, and a small share of it in ``make test``."""

import os

for _name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"  # no thread may live in what is forked
