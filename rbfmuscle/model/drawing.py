"""How an RBF muscle is shown: its field refitted, the bones cut away, the closed surface extracted."""

import time

import numpy as np

from rbfmuscle.geometry.fields import LevelField
from rbfmuscle.implicit.extraction.band import box_along
from rbfmuscle.implicit.extraction.obstacles import ObstaclePoints
from rbfmuscle.implicit.extraction.surface import extract_surface
from rbfmuscle.implicit.field import RBFField
from rbfmuscle.model.options import RBFOptions
from rbfmuscle.model.rest import Rest
from rbfmuscle.sim.loop.contact import BoneContacts
from rbfmuscle.sim.loop.frame import ModelSurface
from rbfmuscle.sim.scene.scene import Scene
from rbfmuscle.validation import SolveError


class SurfaceDrawer:
    """Extracts the surface of one muscle, from frame to frame.

    Parameters
    ----------
    name : str
        The muscle's.
    scene : Scene
    rest : Rest
    options : RBFOptions

    Attributes
    ----------
    level : float
        Of the field that met the rest volume last: where the next search for it begins.
    """

    def __init__(self, name: str, scene: Scene, rest: Rest, options: RBFOptions) -> None:
        self.name, self.rest, self.options = name, rest, options
        self.bone_points = [ObstaclePoints(bone.mesh.vertices) for bone in scene.bones]
        self.level = 0.0

    def extract(self, field: RBFField, points: np.ndarray, contacts: BoneContacts) -> ModelSurface:
        """The closed surface at the rest volume.

        Parameters
        ----------
        field : RBFField
        points : (n, 3) ndarray
            The muscle's contact points: the surface is sought around them.
        contacts : BoneContacts
            What cuts it.

        Raises
        ------
        SolveError
            If there is no closed surface.
        """
        axes = self.rest.axes @ contacts.poses[self.rest.bones[0]][:3, :3].T
        resolution = self.options.resolution
        # Farther than a cell from the bones a lower bound will do: no vertex gets there.
        reach = 1.25 * float(np.diff(box_along(points, axes), axis=0).max()) / resolution
        cut = _BoneCut(contacts, reach) if contacts.names else None
        obstacles = [(self.bone_points[b], contacts.poses[contacts.names[b]]) for b in contacts.reached]
        try:
            result = extract_surface(
                field, points=points, resolution=resolution, cut=cut,
                volume=self.rest.mesh_volume, level=self.level, axes=axes, obstacles=obstacles,
            )  # fmt: skip
        except ValueError as error:
            raise SolveError(
                f"muscle {self.name!r}: no closed surface with kernel "
                f"{self.options.kernel!r} and {len(self.rest.centres)} centres: {error}"
            ) from error
        self.level = result.level
        quantities = {
            "components": result.components,
            "condition": field.condition,
            "level": result.level,
        }
        return ModelSurface(result.vertices, result.faces, quantities)


class RBFDrawing:
    """An RBF muscle as it was at one moment; its field is fitted when it is first asked for.

    Parameters
    ----------
    drawer : SurfaceDrawer
    centres, normals : (K, 3) ndarray
    points : (K + S, 3) ndarray
        Contact points.
    contacts : BoneContacts
        As they stand.
    """

    def __init__(
        self,
        drawer: SurfaceDrawer,
        centres: np.ndarray,
        normals: np.ndarray,
        points: np.ndarray,
        contacts: BoneContacts,
    ) -> None:
        self._drawer, self._centres, self._normals, self._points = drawer, centres, normals, points
        self._depth, self._contacts = contacts.depth(points), contacts.frozen()
        self._fitted: RBFField | None = None
        self._time_fit = 0.0

    def field(self) -> LevelField:
        """The field that the surface is drawn by, less the level that the frame before came to."""
        return LevelField(self._fit(), self._drawer.level)

    def surface(self) -> ModelSurface:
        """The closed surface at the rest volume, cut by what lay in the way."""
        field = self._fit()
        started = time.perf_counter()
        surface = self._drawer.extract(field, self._points, self._contacts)
        surface.quantities.update(
            time_fit=self._time_fit,
            time_extract=time.perf_counter() - started,
            solver_penetration_max=self._depth,
        )
        return surface

    def _fit(self) -> RBFField:
        if self._fitted is None:
            started = time.perf_counter()
            self._fitted = self._drawer.rest.fit.fit(self._centres, self._normals)
            self._time_fit = time.perf_counter() - started
        return self._fitted


class _BoneCut:
    """What the bones cut away: their smallest distance, a lower bound where it is beyond ``reach``."""

    def __init__(self, contacts, reach):
        self.contacts, self.reach = contacts, reach

    def __call__(self, points):
        return self.contacts.nearest(points, self.reach)

    def value_and_gradient_below(self, points, limit):
        return self.contacts.nearest_with_gradient(points, limit)
