"""The ARAP energy of a mesh, written out: what its rotations and gradients are measured by."""

from scipy.spatial.transform import Rotation


def energy(arap, points):
    """E(x) = 1/4 sum of w_ij (|e_ij - R_i E_ij|² + |e_ij - R_j E_ij|²) over the edges, with the present rotations."""
    i, j = arap.topology.edges.T
    turns = Rotation.from_quat(arap.quaternions[:, [1, 2, 3, 0]])
    apart = points[i] - points[j]
    misfit = sum(((apart - turns[k].apply(arap.rest)) ** 2).sum(axis=1) for k in (i, j))
    return 0.25 * float(arap.weights @ misfit)


def gradient(arap, points):
    """Its derivative by the points with the rotations frozen, as the global step has it."""
    return arap.laplacian @ points - arap.targets()
