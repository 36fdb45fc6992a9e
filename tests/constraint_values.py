"""What the constraints of mesh muscles keep at zero."""

import numpy as np

from pbd_baseline.constraints import TINY, BendingConstraint, _dihedral_loop


def constraint_values(constraint, points):
    """C of each edge or fold, in the order of the constraint."""
    if not isinstance(constraint, BendingConstraint):
        one, other = points[constraint.edges].swapaxes(0, 1)
        return np.linalg.norm(one - other, axis=1) - constraint.rest
    now, rest = np.empty_like(constraint.rest), constraint.rest
    _dihedral_loop(points, constraint.members, now)
    sine = now[:, 1] * rest[:, 0] - now[:, 0] * rest[:, 1]
    cosine = now[:, 0] * rest[:, 0] + now[:, 1] * rest[:, 1]
    return 2.0 * sine / np.maximum(1.0 + cosine, TINY)
