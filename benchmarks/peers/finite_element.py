"""A volumetric finite-element solid, nearly incompressible, quasi-static, against bones: a
reference for models.

Eight-node bricks, or tetrahedra of ten nodes, with a constant pressure each (mean dilatation: Simo,
Taylor and Pister 1985), neo-Hookean,

    W = mu/2 (J^(-2/3) tr(F'F) - 3) + kappa/2 (Jm - 1)^2,   Jm = mean of J over the cell,

with fibres, where a `peers.fibre_material.FibreMaterial` is given, whose energy along the stretch
|F a| is added; solved by Newton's method with a line search on the energy. Bones push by a penalty
on the surface's quadrature points. Mesh, shape functions and quadrature are scikit-fem's (the extra
``fem``).
"""

import numpy as np
import scipy.sparse as sparse
from scipy.spatial import cKDTree

from peers.load_steps import SolidState, positive_factor
from rbfmuscle.validation import MissingDependencyError, SolveError

MOST_ITERATIONS = 60
# A step that would lower the energy by a smaller share than this changes nothing that is looked at;
# facets of bones have edges, at which the forces themselves need not settle.
ENERGY_TOLERANCE = 2e-6
# Least stiffness of a point where the true ones are not all positive [shear modulus].
LEAST_STIFF = 0.01


def _skfem():
    try:
        import skfem
    except ImportError as error:
        raise MissingDependencyError(
            "solids of finite elements need scikit-fem: pip install -e '.[fem]' in "
            "rbfmuscle's folder"
        ) from error
    return skfem


class Equilibrium:
    """Newton's method for whatever has an energy.

    A class that derives from it has the nodes ``rest`` (n, 3), a modulus ``shear`` and the
    functions ``energy(displacement)`` and ``_assemble(displacement, positive=False)``.
    """

    def solve(self, displacement, held, wanted, *, tolerance=1e-6, settled=ENERGY_TOLERANCE):
        """Equilibrium with what is ``held`` at the displacements ``wanted`` (n, 3).

        Parameters
        ----------
        displacement : (n, 3) ndarray
            Where to start from.
        held : (n,) or (n, 3) ndarray of bool
            Nodes, or single directions of nodes.
        wanted : (n, 3) ndarray
        tolerance : float
            Of the greatest force on a free node, as a share of the greatest force.
        settled : float
            A step that would lower the energy by a smaller share is the last.

        Returns
        -------
        SolidState

        Raises
        ------
        SolveError
            If Newton's method does not get there, for instance because cells turn inside out.
        """
        held = np.broadcast_to(held.reshape(len(held), -1), displacement.shape)
        free = ~held.ravel()
        first = np.where(held, wanted - displacement, 0.0).ravel()
        u = displacement.copy()
        for iteration in range(MOST_ITERATIONS):
            force, matrix = self._assemble(u)
            scale = max(np.abs(force).max(), 1e-9 * self.shear)
            residual = float(np.abs(force[free]).max() / scale)
            if not first.any() and residual < tolerance:
                return SolidState(u, iteration, residual)
            step = self._direction(u, force, matrix, free, first)
            if not first.any() and abs(force @ step) < settled * self.energy(u):
                return SolidState(u, iteration, residual)
            u = self._walk(u, step.reshape(-1, 3), force, moving=first.any())
            first = np.zeros_like(first)
        raise SolveError(
            f"no equilibrium after {MOST_ITERATIONS} iterations, residual {residual:.1e}"
        )

    def _direction(self, u, force, matrix, free, first):
        """Newton's step; where the stiffness is not positive, with that of each cell made so."""
        step = first.copy()
        for positive in (False, True):
            if positive:
                matrix = self._assemble(u, positive=True)[1]
            inner = matrix[free][:, free]
            try:
                factor = positive_factor(inner)
            except np.linalg.LinAlgError:
                continue
            step[free] = factor.solve(-(force + matrix @ first)[free])
            if np.isfinite(step).all() and (first.any() or force @ step < 0.0):
                return step
        raise SolveError("the stiffness of the cells is singular, take smaller steps")

    def _walk(self, u, step, force, *, moving):
        """Longest of the halved steps that lowers the energy; one that moves held nodes must only
        stay valid.
        """
        if moving:
            if not np.isfinite(self.energy(u + step)):
                raise SolveError("cells turn inside out, take smaller steps")
            return u + step
        here, slope = self.energy(u), float(force @ step.ravel())
        share = 1.0
        for _ in range(20):
            if self.energy(u + share * step) <= here + 1e-4 * share * slope + 1e-12 * abs(here):
                return u + share * step
            share *= 0.5
        raise SolveError("no step lowers the energy, take smaller steps")


class HexSolid(Equilibrium):
    """A solid of bricks.

    Parameters
    ----------
    points : (n, 3) ndarray
        Corners at rest [scene unit].
    cells : (m, 8) ndarray of int
        In scikit-fem's order, as `brick_grid` gives them.
    shear : float
        Shear modulus; the unit of stress.
    poisson : float
        Poisson's ratio; 0.495 makes the bulk modulus a hundred times the shear modulus.
    fibres : FibreMaterial, optional
    stiffer : (m,) ndarray, optional
        Factor of the shear and bulk moduli of each cell.
    penalty : float
        Contact pressure for each unit of depth [shear modulus / scene unit].

    Attributes
    ----------
    rest : (N, 3) ndarray
        Nodes, of which the first are the corners.

    Raises
    ------
    MissingDependencyError
        If scikit-fem is not installed.
    """

    kind, integrated = (
        ("MeshHex", "ElementHex1"),
        3,
    )  # in scikit-fem, and the degree that is integrated exactly

    def __init__(
        self, points, cells, *, shear=1.0, poisson=0.495, penalty=30.0, fibres=None, stiffer=None
    ):
        skfem = _skfem()
        self.shear, self.penalty = shear, penalty
        self.fibres, self.activation = fibres, 0.0
        self.stiffer = np.ones(len(cells)) if stiffer is None else np.asarray(stiffer, dtype=float)
        self.bulk = 2.0 * shear * (1.0 + poisson) / (3.0 * (1.0 - 2.0 * poisson))
        mesh, element = (getattr(skfem, name) for name in self.kind)
        mesh = mesh(np.ascontiguousarray(points.T), np.ascontiguousarray(cells.T))
        element = element()
        basis = skfem.Basis(mesh, element, intorder=self.integrated)
        self.mesh, self.rest = mesh, np.ascontiguousarray(basis.doflocs.T)
        # (cell, quadrature point, node, direction): derivatives of the shape functions at rest.
        self.slopes = np.stack([np.moveaxis(b[0].grad, 0, -1) for b in basis.basis], axis=2)
        self.weights, self.nodes = basis.dx, basis.element_dofs.T
        self.facets = mesh.boundary_facets()
        self.side_cells = mesh.f2t[0, self.facets]
        self.side_nodes = self.nodes[self.side_cells]
        self.side_shape, self.side_weights = self._sides(skfem, element)
        self.obstacles = ()
        self.places = None

    def _sides(self, skfem, element):
        """Shape functions (k, 4, 8) of the cells behind the boundary's faces, at two by two Gauss
        points of each face, and the areas (k, 4) of these.

        scikit-fem looks for the points by Newton's method, which fails where two sides of a face
        are nearly in line.
        """
        corners = np.asarray(element.doflocs)  # of the unit cube
        on_face = (self.side_nodes[:, :, None] == self.surface_faces()[:, None, :]).any(axis=2)
        shape = np.empty((len(self.facets), 4, 8))
        area = np.empty((len(self.facets), 4))
        gauss = 0.5 + np.array([-0.5, 0.5]) / np.sqrt(3.0)
        for axis in range(3):
            free = [a for a in range(3) if a != axis]
            for side in (0.0, 1.0):
                faces = np.flatnonzero((on_face == (corners[:, axis] == side)).all(axis=1))
                here = self.rest[self.side_nodes[faces]]
                for q, point in enumerate(np.stack(np.meshgrid(gauss, gauss), -1).reshape(-1, 2)):
                    local = np.full(3, side)
                    local[free] = point
                    parts = np.where(corners == 1.0, local, 1.0 - local)
                    shape[faces, q] = parts.prod(axis=1)
                    slopes = [
                        np.where(corners[:, a] == 1.0, 1.0, -1.0)
                        * np.delete(parts, a, axis=1).prod(axis=1)
                        for a in free
                    ]
                    across = np.cross(*(np.einsum("n,fni->fi", slope, here) for slope in slopes))
                    area[faces, q] = 0.25 * np.linalg.norm(across, axis=1)
        return shape, area

    def surface_faces(self):
        """Corner nodes of the boundary, (k, 4) or (k, 3), in scikit-fem's order."""
        return self.mesh.facets[:, self.facets].T

    def set_obstacles(self, obstacles, attached, *, inner=False):
        """Bones that push.

        Parameters
        ----------
        obstacles : callable
            ``obstacles(points)`` gives distances (n,), negative inside, and directions (n, 3).
        attached : (n,) ndarray of bool
            Nodes on bones; faces with any of them take no contact.
        inner : (k,) ndarray of bool, optional
            Faces that are no surface, as those on a plane of symmetry.
        """
        self.obstacles = obstacles
        on_face = np.abs(self.side_shape).max(axis=1) > 1e-9
        self.touching = ~((attached[self.side_nodes] & on_face).any(axis=1) | inner)

    def volume(self, displacement):
        """Volume of the deformed cells [scene unit cubed]."""
        return float((np.linalg.det(self._gradient(displacement)) * self.weights).sum())

    def energy(self, displacement):
        """Elastic and contact energy; infinite where a cell is turned inside out."""
        f = self._gradient(displacement)
        j = np.linalg.det(f)
        if j.min() <= 0.0:
            return np.inf
        mean = (j * self.weights).sum(axis=1) / self.weights.sum(axis=1)
        shape = j ** (-2 / 3) * np.einsum("eqij,eqij->eq", f, f) - 3.0
        total = 0.5 * self.shear * (shape * self.weights * self.stiffer[:, None]).sum()
        total += (
            0.5 * self.bulk * ((mean - 1.0) ** 2 * self.weights.sum(axis=1) * self.stiffer).sum()
        )
        if self.fibres is not None:
            total += (
                self.fibres.evaluate(self._along(f)[1], self.activation)[0] * self.weights
            ).sum()
        if self.obstacles:
            depth = np.minimum(self.gaps(displacement)[0], 0.0)
            total += 0.5 * self.penalty * (depth**2 * self.side_weights[self.touching]).sum()
        return float(total)

    def _along(self, f):
        """F a (cell, point, 3) and its length, the stretch of the fibres."""
        along = np.einsum("eqij,ej->eqi", f, self.fibres.direction)
        return along, np.linalg.norm(along, axis=-1)

    def _fibre_stress(self, f):
        """Stress (cell, point, 3, 3) of the fibres, and its derivative by F (brick, point, 9,
        9)."""
        along, stretch = self._along(f)
        _, slope, bend = self.fibres.evaluate(stretch, self.activation)
        a = self.fibres.direction
        unit = along / stretch[..., None]
        stress = np.einsum("eq,eqi,ej->eqij", slope, unit, a)
        across = np.einsum("eqi,eqk->eqik", unit, unit)
        spatial = bend[..., None, None] * across + (slope / stretch)[..., None, None] * (
            np.eye(3) - across
        )
        tangent = np.einsum("eqik,ej,el->eqijkl", spatial, a, a)
        return stress, tangent.reshape(*stretch.shape, 9, 9)

    def _gradient(self, displacement):
        return np.eye(3) + np.einsum(
            "eni,eqnj->eqij", displacement[self.nodes], self.slopes, optimize=True
        )

    def gaps(self, displacement):
        """Distances (faces, points) and directions (faces, points, 3) of the free surface to the
        bones.
        """
        shape, nodes = self.side_shape[self.touching], self.side_nodes[self.touching]
        points = np.einsum("fqn,fni->fqi", shape, (self.rest + displacement)[nodes])
        gap, direction = self.obstacles(points.reshape(-1, 3))
        return gap.reshape(points.shape[:2]), direction.reshape(points.shape)

    def _assemble(self, displacement, *, positive=False):
        """Forces (3 n,) and their derivative, a sparse (3 n, 3 n) matrix, or one near it that is
        positive.
        """
        local, stiffness = self._elastic(displacement, positive)
        if self.obstacles:
            # A face's nodes are those of its cell.
            cells, pushed, hard = self._contact(displacement)
            np.add.at(local, cells, pushed)
            np.add.at(stiffness, cells, hard)
        index, pattern, place = self._pattern()
        force = np.bincount(index.ravel(), local.ravel(), 3 * len(self.rest))
        data = np.bincount(place, stiffness.ravel(), len(pattern.data))
        return force, sparse.csr_array((data, pattern.indices, pattern.indptr), shape=pattern.shape)

    def _pattern(self):
        """Unknowns of each cell, the matrix's pattern, and where each entry of the cells'
        stiffnesses goes in it.
        """
        if self.places is None:
            index = (3 * self.nodes[:, :, None] + np.arange(3)).reshape(len(self.nodes), -1)
            size, width = 3 * len(self.rest), index.shape[1]
            key = np.repeat(index, width, axis=1).ravel() * size + np.tile(index, width).ravel()
            known, place = np.unique(key, return_inverse=True)
            pattern = sparse.csr_array(
                (np.ones(len(known)), (known // size, known % size)), shape=(size, size)
            )
            self.places = index, pattern, place.ravel()
        return self.places

    def _elastic(self, displacement, positive):
        f = self._gradient(displacement)
        j = np.linalg.det(f)
        inverse = np.swapaxes(np.linalg.inv(f), -1, -2)  # F^-T
        volume = self.weights.sum(axis=1)
        bulk = self.bulk * self.stiffer
        pressure = bulk * ((j * self.weights).sum(axis=1) / volume - 1.0)
        factor = self.shear * self.stiffer[:, None] * j ** (-2 / 3)
        trace = np.einsum("eqij,eqij->eq", f, f)
        cofactor = j[..., None, None] * inverse
        stress = factor[..., None, None] * (f - (trace / 3)[..., None, None] * inverse)
        stress += pressure[:, None, None, None] * cofactor
        tangent = self._tangent(f, inverse, factor, trace, pressure[:, None] * j)
        if self.fibres is not None:
            pull, bend = self._fibre_stress(f)
            stress, tangent = stress + pull, tangent + bend
        if positive:
            value, vector = np.linalg.eigh(tangent)
            tangent = (
                vector * np.maximum(value, LEAST_STIFF * self.shear)[..., None, :]
            ) @ np.swapaxes(vector, -1, -2)
        weighted = self.slopes * self.weights[..., None, None]
        count, size = len(self.nodes), 3 * self.nodes.shape[1]
        force = np.einsum("eqij,eqnj->eni", stress, weighted, optimize=True).reshape(count, size)
        stiffness = np.zeros((count, size, size))
        for q in range(self.slopes.shape[1]):
            b = np.einsum("enj,ik->eijnk", self.slopes[:, q], np.eye(3)).reshape(count, 9, size)
            stiffness += np.swapaxes(b, 1, 2) @ (tangent[:, q] * self.weights[:, q, None, None]) @ b
        mean = np.einsum("eqij,eqnj->eni", cofactor, weighted, optimize=True).reshape(count, size)
        stiffness += (bulk / volume)[:, None, None] * mean[:, :, None] * mean[:, None, :]
        return force, stiffness

    @staticmethod
    def _tangent(f, inverse, factor, trace, pressure):
        """Derivative of the stress by F at fixed mean dilatation, (cell, point, 9, 9)."""
        count = f.shape[:2]
        g, h = f.reshape(*count, 9), inverse.reshape(*count, 9)
        crossed = np.einsum("eqil,eqkj->eqijkl", inverse, inverse, optimize=True).reshape(
            *count, 9, 9
        )
        mixed = g[..., :, None] * h[..., None, :]
        out = np.eye(9) - (2 / 3) * (mixed + np.swapaxes(mixed, -1, -2))
        square = h[..., :, None] * h[..., None, :]
        out = (
            out + (2 / 9) * trace[..., None, None] * square + (trace / 3)[..., None, None] * crossed
        )
        return factor[..., None, None] * out + pressure[..., None, None] * (square - crossed)

    def _contact(self, displacement):
        gap, direction = self.gaps(displacement)
        shape = self.side_shape[self.touching]
        depth = np.minimum(gap, 0.0) * self.side_weights[self.touching] * self.penalty
        active = (gap < 0.0) * self.side_weights[self.touching] * self.penalty
        pushed = np.einsum("fqn,fqi->fqni", shape, direction).reshape(*shape.shape[:2], -1)
        force = np.einsum("fq,fqa->fa", depth, pushed)
        stiffness = np.einsum("fq,fqa,fqb->fab", active, pushed, pushed, optimize=True)
        return self.side_cells[self.touching], force, stiffness


class TetSolid(HexSolid):
    """A solid of tetrahedra of ten nodes, edges straight at rest; ``cells`` (m, 4)."""

    kind, integrated = ("MeshTet", "ElementTetP2"), 2

    def _sides(self, skfem, element):
        """Shape functions (k, q, 10) of the cells behind the boundary's faces, at points of each
        face, and the areas (k, q) of these.
        """
        side = skfem.FacetBasis(self.mesh, element, facets=self.facets, intorder=3)
        shapes = [np.broadcast_to(np.asarray(b[0]), side.dx.shape) for b in side.basis]
        return np.stack(shapes, axis=-1), np.abs(side.dx)

    def skin(self):
        """Numbers of the nodes of the boundary, those of its edges' middles among them."""
        on_face = np.abs(self.side_shape).max(axis=1) > 1e-9
        return np.unique(self.side_nodes[on_face])

    def at(self, points):
        """Nodes (n, 10) and their shares (n, 10) at points of the solid at rest, or just outside of
        it.
        """
        corners = self.rest[self.nodes[:, :4]]
        inverse = np.linalg.inv(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2))
        _, near = cKDTree(corners.mean(axis=1)).query(points, k=min(NEAR, len(corners)))
        part = np.einsum("nkij,nkj->nki", inverse[near], points[:, None] - corners[near, 0])
        shares = np.concatenate([1.0 - part.sum(axis=-1, keepdims=True), part], axis=-1)
        row, best = np.arange(len(points)), np.argmax(shares.min(axis=-1), axis=1)
        b = shares[row, best]
        middles = [4.0 * b[:, i] * b[:, j] for i, j in EDGES]
        return self.nodes[near[row, best]], np.stack([*(b * (2.0 * b - 1.0)).T, *middles], axis=1)


# Cells around a point that are asked whether they hold it; corners of a tetrahedron's edges, in
# scikit-fem's order.
NEAR = 60
EDGES = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))


def brick_grid(cells):
    """Nodes in the cube [-1, 1]^3 and bricks of a regular grid of ``cells`` (three numbers)."""
    skfem = _skfem()
    mesh = skfem.MeshHex.init_tensor(*(np.linspace(-1.0, 1.0, n + 1) for n in cells))
    return mesh.p.T.copy(), mesh.t.T.copy()
