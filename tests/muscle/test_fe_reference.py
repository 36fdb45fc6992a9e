"""The finite-element solid against known answers, and the models against the reference that it
gave.
"""

from importlib import import_module

import numpy as np
import pytest
from conftest import ROOT
from scipy.optimize import brentq

study = import_module("fe_reference")  # the script in benchmarks

DATA = ROOT / "tests" / "data" / "fe_reference.npz"


HALF = np.array([5.0, 5.0, 20.0])


def block(cells=(3, 3, 4)):
    from peers.finite_element import HexSolid, brick_grid

    cube, bricks = brick_grid(cells)
    return HexSolid(cube * HALF, bricks)


def prism(cells=(2, 2, 5)):
    import skfem
    from peers.finite_element import TetSolid

    mesh = skfem.MeshTet.init_tensor(*(np.linspace(-h, h, n + 1) for h, n in zip(HALF, cells)))
    return TetSolid(mesh.p.T, mesh.t.T)


def side_stretch(stretch, solid):
    """Side stretch of a block pulled by ``stretch`` with free sides: no stress across, in closed
    form.
    """

    def across(side):
        j = stretch * side**2
        trace = stretch**2 + 2 * side**2
        return (
            solid.shear * j ** (-2 / 3) * (side - trace / 3 / side)
            + solid.bulk * (j - 1) * j / side
        )

    return brentq(across, 0.3, 1.5, xtol=1e-14)


@pytest.mark.parametrize(
    ("kind", "stretch"), [(block, 0.8), (block, 1.6), (prism, 0.8), (prism, 1.4)]
)
def test_uniaxial_stretch_is_the_closed_form(kind, stretch):
    solid = kind()
    x = solid.rest
    u, wanted = np.zeros_like(x), np.zeros_like(x)
    # Ends on rollers; three nodes keep the block from floating off.
    held = np.zeros(x.shape, dtype=bool)
    held[np.abs(x[:, 2]) > 19.99, 2] = True
    corner = np.argmin(x.sum(axis=1))
    held[corner] = True
    held[np.argmin(np.linalg.norm(x - x[corner] - [10, 0, 0], axis=1)), 1] = True
    for part in np.linspace(1.0, stretch, 6)[1:]:
        wanted[:, 2] = (part - 1) * x[:, 2]
        wanted[corner, :2] = u[corner, :2]
        u = solid.solve(u, held, wanted, tolerance=1e-9).displacement
    side = side_stretch(stretch, solid)
    exact = (x - x[corner]) * [side, side, stretch]
    # The energy's tolerance ends Newton's steps, hence 1e-4 of the side.
    assert np.abs((x + u) - (x + u)[corner] - exact).max() < 1e-3
    assert solid.volume(u) == pytest.approx(4000 * stretch * side**2, rel=5e-5)
    # Nearly incompressible: Poisson's ratio 0.495 leaves some tenths of a percent.
    assert abs(stretch * side**2 - 1) < 0.01


@pytest.mark.parametrize(("model", "limit"), [("rbf", 4.5), ("arap-volume", 8.0)])
def test_models_stay_near_the_reference(model, limit):
    rows = study.distances(model, DATA)
    assert [row[0] for row in rows] == pytest.approx(study.ANGLES)
    assert rows[0][1] < 0.35
    assert max(row[1] for row in rows) < limit
