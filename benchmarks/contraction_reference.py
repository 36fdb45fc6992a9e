"""Finite-element cases of muscles that contract, kept as small data files.

    python benchmarks/contraction_reference.py [--cells 64 6] [--activations 0 0.25 0.5 0.75 1] [FILE]

A spindle of muscle between two tendons whose far ends stand still (`peers.contraction_scenes.Spindle`), fibres along
it with the active stress of Blemker et al. 2005 (`peers.fibre_material`), nearly incompressible, in quasi-static steps
of activation. The file keeps the outer surface at each activation: vertices (t, n, 3) and faces, and where each
vertex lay at rest. ``benchmarks/contraction_measures.py`` measures any model's surfaces against it.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from peers.contraction_scenes import SPINDLE
from peers.fibre_material import FibreMaterial
from peers.finite_element import HexSolid, brick_grid

DATA = Path(__file__).resolve().parents[1] / "tests" / "data" / "contraction_spindle.npz"
CELLS = (64, 6)  # along, across
STEP = 0.05  # of activation
PEAK = 30.0  # active stress over the ground's shear modulus: 0.3 MPa over 10 kPa
STRAIN = 0.08  # of the tendon at the greatest isometric force: its stiffness is PEAK / STRAIN
POISSON = 0.4995  # bulk modulus a thousand times the shear modulus
GROUND = 10.0  # shear modulus of the tendon's ground over the muscle's


class Spindle:
    """The solid, its fibres and what is held.

    Parameters
    ----------
    cells : (int, int)
        Bricks along and across.
    shape : peers.contraction_scenes.Spindle
    """

    def __init__(self, cells=CELLS, *, shape=SPINDLE):
        cube, bricks = brick_grid((cells[0], cells[1], cells[1]))
        self.shape, self.cube = shape, cube
        self.points = self.place(cube)
        middle = cube[bricks].mean(axis=1)
        x, p, q = self.disc(middle)
        radius, slope = shape.radius(x)
        along = np.column_stack([np.ones(len(x)), p * slope, q * slope])
        tendon = np.abs(x) > 0.5 * shape.belly_length
        fibres = FibreMaterial(
            along / np.linalg.norm(along, axis=1, keepdims=True), tendon, (shape.belly / radius) ** 2,
            peak=PEAK, stiffness=PEAK / STRAIN,
        )  # fmt: skip
        stiffer = np.where(tendon, GROUND, 1.0)
        self.solid = HexSolid(self.points, bricks, poisson=POISSON, fibres=fibres, stiffer=stiffer)
        self.held = np.abs(self.points[:, 0]) > 0.5 * shape.length - 1e-6

    def disc(self, cube):
        """Place along the axis, and shares of the radius across, for points of the cube."""
        t, x, y = cube.T
        p, q = x * np.sqrt(1 - y**2 / 2), y * np.sqrt(1 - x**2 / 2)
        return 0.5 * self.shape.length * t, p, q

    def place(self, cube):
        """Points of the solid for points of the cube [-1, 1]^3 (along, across, across)."""
        x, p, q = self.disc(cube)
        radius = self.shape.radius(x)[0]
        return np.column_stack([x, p * radius, q * radius])

    def surface(self):
        """Outward triangles of the outer surface over the nodes, (m, 3)."""
        a, b, c, d = self.solid.surface_faces().T
        # scikit-fem numbers a facet's corners around it or crosswise; the longer pair is the diagonal.
        faces = []
        for corners in zip(a, b, c, d):
            loop = _around(self.points[list(corners)], corners)
            faces += [(loop[0], loop[1], loop[2]), (loop[0], loop[2], loop[3])]
        faces = np.array(faces)
        normal = np.cross(
            self.points[faces[:, 1]] - self.points[faces[:, 0]],
            self.points[faces[:, 2]] - self.points[faces[:, 0]],
        )
        outward = self.points[faces].mean(axis=1) * [1e-3, 1, 1]
        ends = np.abs(normal[:, 0]) > 0.99 * np.linalg.norm(normal, axis=1)
        outward[ends] = self.points[faces[ends]].mean(axis=1) * [1, 0, 0]
        wrong = np.einsum("ij,ij->i", normal, outward) < 0.0
        faces[wrong] = faces[wrong][:, ::-1]
        return faces

    def run(self, activations):
        """Yield (activation, displacement (n, 3), Newton iterations, residual, volume error) at each of them."""
        u = np.zeros_like(self.points)
        rest = self.solid.volume(u)
        now = 0.0
        for goal in activations:
            state = None
            for value in np.linspace(now, goal, max(1, round(abs(goal - now) / STEP)) + 1)[1:]:
                self.solid.activation = float(value)
                state = self.solid.solve(u, self.held, np.zeros_like(u), settled=1e-12)
                u = state.displacement
            now = goal
            made = (0, 0.0) if state is None else (state.iterations, state.residual)
            yield goal, u, *made, self.solid.volume(u) / rest - 1.0


def _around(points, corners):
    """The four corners in order around their facet."""
    centre = points.mean(axis=0)
    axis = np.linalg.svd(points - centre)[2][:2]
    angle = np.arctan2((points - centre) @ axis[1], (points - centre) @ axis[0])
    return [corners[k] for k in np.argsort(angle)]


def solve(path, cells, activations):
    """Run the case and keep its surfaces."""
    start = time.process_time()
    case = Spindle(cells)
    faces = case.surface()
    used = np.unique(faces)
    places, volumes = [], []
    for activation, u, iterations, residual, volume in case.run(activations):
        places.append(np.round((case.points + u)[used], 4).astype(np.float32))
        volumes.append(volume)
        radius = np.linalg.norm(places[-1][:, 1:], axis=1).max()
        print(f"{activation:5.2f}: {iterations} iterations, {residual:.1e}, volume {volume:+.1e}, "
              f"greatest radius {radius:.3f} mm", flush=True)  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(
        path, activations=activations, vertices=np.array(places), faces=np.searchsorted(used, faces).astype(np.int32),
        volume_error=volumes, cells=cells, peak=PEAK, strain=STRAIN, ground=GROUND,
    )  # fmt: skip
    print(f"{path}: {path.stat().st_size} bytes, {time.process_time() - start:.0f} s of processor time")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", nargs="?", type=Path, default=DATA)
    parser.add_argument("--cells", nargs=2, type=int, default=CELLS)
    parser.add_argument("--activations", nargs="+", type=float, default=(0.0, 0.25, 0.5, 0.75, 1.0))
    given = parser.parse_args()
    solve(given.file, tuple(given.cells), tuple(given.activations))


if __name__ == "__main__":
    main()
