"""Parts of the library give for small seeded inputs what they gave; known answers and laws are in
their own tests.
"""

import math

import numpy as np
import pytest
import trimesh
from kept import check_kept

from rbfmuscle.bones.errors import measure_field
from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.geometry import (
    bsplines,
    coarse,
    crossing,
    harmonic,
    rotations,
    surfaces,
    triangles,
    tubes,
)
from rbfmuscle.geometry.exact_distance import faces_across
from rbfmuscle.geometry.rest_frame import BoneFrame, moved_box
from rbfmuscle.geometry.winding import winding_loop
from rbfmuscle.implicit.extraction.surface import extract_surface, find_sheets
from rbfmuscle.implicit.field import FieldFit, RBFField, off_surface_points
from rbfmuscle.implicit.kernels.table import get_kernel
from rbfmuscle.implicit.placement.lattice import Lattice
from rbfmuscle.implicit.placement.refinement import fit_sample
from rbfmuscle.implicit.placement.sampling import sample_surface, spread_points
from rbfmuscle.implicit.selection import choose_epsilon, spacing
from rbfmuscle.metrics.mesh_distance import MeshDistance
from rbfmuscle.muscle.fibres import fibre_directions


def ball(radii=(1.0, 1.0, 1.0), subdivisions=3, bumps=0.0):
    """Vertices and faces of an ellipsoid, with bumps by which nothing is symmetric."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    v = np.array(mesh.vertices)
    x, y, z = v.T
    v *= (
        1.0
        + bumps * (np.sin(3.0 * x + 0.3) * np.cos(2.0 * y - 0.4) + 0.5 * np.sin(4.0 * z))[:, None]
    )
    return v * radii, np.array(mesh.faces)


def turned(angle, axis=(1.0, 2.0, 3.0), shift=(0.3, -0.2, 0.1)):
    """A rigid motion (4, 4)."""
    pose = trimesh.transformations.rotation_matrix(angle, axis)
    pose[:3, 3] = shift
    return pose


def _bones():
    opened = trimesh.creation.icosphere(subdivisions=3, radius=20.0)
    opened.update_faces(np.asarray(opened.triangles_center[:, 2] < 17.0))
    ring = trimesh.creation.torus(20.0, 6.0, major_sections=24, minor_sections=12)
    boxes = [
        trimesh.creation.box((30, 20, 10)).apply_translation(t) for t in ([0, 0, 0], [9, 7, 4])
    ]
    meshes = {
        "plate": trimesh.creation.box((60, 1.5, 40)),
        "open": opened,
        "pointed": trimesh.creation.icosphere(subdivisions=0).apply_scale([15.0, 9.0, 4.0]),
        "ring": trimesh.Trimesh(
            ring.vertices + np.sin(0.2 * ring.vertices[:, [1, 2, 0]]), ring.faces, process=False
        ),
        "bumpy": trimesh.Trimesh(*ball((40, 22, 15), bumps=0.15), process=False),
        "crossing": trimesh.util.concatenate(boxes),
    }
    options = {"plate": {"region": [[-10, -5, -5], [50, 9, 30]]}, "ring": {"memory_limit": 400_000}}
    for name, mesh in meshes.items():
        rng, pose = np.random.default_rng(3), turned(0.7)
        field = BoneSDF.from_mesh(mesh, cache=False, **options.get(name, {}))
        near = np.repeat(mesh.vertices, 300 // len(mesh.vertices) + 1, axis=0)
        near += rng.normal(scale=0.2, size=near.shape)
        wide, far = rng.uniform(*(1.5 * mesh.bounds), (300, 3)), 200.0 * rng.normal(size=(40, 3))
        points = trimesh.transform_points(np.concatenate([wide, near, far]), pose)
        yield (
            name,
            {
                "far": field.distance_and_gradient(points, pose),
                "reach": field.distance(points, pose, reach=2.0),
                "about": {n: math.log(a.size + 1) for n, a in field.data._asdict().items()},
                "spacing": field.spacing,
                "error": field.error,
                "errors": measure_field(field, count=500),
                "closed": field.closed,
                "notes": len(field.notes),
                "bounds": field.bounds,
                "exact": field.exact.signed_distance(points),
            },
        )


def _fields():
    vertices, faces = ball((3.0, 2.0, 1.2), bumps=0.1)
    points = np.random.default_rng(8).uniform(-4.0, 4.0, (100, 3))
    distance, held_out = (
        MeshDistance(vertices, faces).signed,
        spread_points(vertices, faces, 300, seed=1),
    )
    yield (
        held_out,
        *(sample_surface(vertices, faces, 40, placement=name) for name in ("even", "adaptive")),
    )
    sample = sample_surface(vertices, faces, 40, placement="greedy")
    places = sample.points, sample.normals
    yield sample, spacing(sample.points), off_surface_points(*places)
    for name in ("cubic", "gaussian", "wendland_c2"):
        fit = FieldFit(get_kernel(name), 0.4, 1e10)
        field = fit.fit(*places)
        yield field.value_and_gradient(points), math.log(field.condition), field.terms.a
        yield fit_sample(sample, vertices, faces, fit=fit)
        if name != "cubic":
            yield choose_epsilon(*places, fit, held_out=held_out[0], distance=distance)
    two = np.arange(40).reshape(2, 20)
    for more in ({"smoothing": 1e-3}, {"parts": two}, {"kernel": "quintic", "condition": 1e6}):
        yield RBFField.fit_hermite(*places, **more).value_and_gradient(points)
    for more in ({}, {"kernel": "linear", "smoothing": 1e-2}):
        yield RBFField.fit(vertices[::9], distance(1.1 * vertices[::9]), **more)(points)
    field = RBFField.fit_hermite(*places)
    yield find_sheets(field, sample.points, distance)
    for more in ({}, {"volume": 0.9 * surfaces.mesh_volume(vertices, faces)}, {"resolution": 20}):
        found = extract_surface(field, points=sample.points, **more)
        yield {"about": len(found.vertices), "volume": found.volume, "level": found.level}


def _surfaces():
    rng, (vertices, faces) = np.random.default_rng(5), ball((3.0, 2.0, 1.2), 2, bumps=0.1)
    noise, few = rng.normal(size=vertices.shape), faces[:200]
    for crumpled in (vertices + 0.1 * noise, vertices + 0.4 * noise):
        yield crossing.crossing_faces(crumpled, faces), crossing.crossing_faces(crumpled, few)
        yield crossing.FaceTree(vertices, faces).crossing(crumpled, np.arange(len(faces)) % 9 == 0)
        turns, plain = np.zeros(162, dtype=np.int64), np.ones(162, dtype=bool)
        crossing._plain_loop(crumpled, faces, np.zeros((162, 3)), turns, plain)
        yield turns, plain
    weights = harmonic.harmonic_weights(vertices, faces, [[0], [7, 8, 9], [50], [100, 101]])
    yield weights, harmonic.surface_gradient(vertices, faces, noise[:, 0])
    poses = np.stack(
        [turned(angle, shift=3.0 * noise[k]) for k, angle in enumerate((0.0, 1e-7, 0.5, 3.1))]
    )
    for share in (weights, *np.eye(4)[:, None].repeat(len(vertices), 1)):
        yield harmonic.blended_motion(vertices, share, poses)
    turns = np.array(
        [rotations.matrix_quaternion(turned(angle)) for angle in np.linspace(-6.0, 6.0, 25)]
    )
    for sizes in ((3.0, 1.0, 0.5), (1.0, 0.2, -0.1), (1.0, 1e-4, 0.0)):
        yield turns.copy()
        for q, m in zip(turns, map(np.linalg.svd, noise.reshape(-1, 3, 3))):
            rotations.rotation_loop(m[0] * sizes @ m[2], q)
    yield (
        [rotations.rotate(q, x) for q, x in zip(turns, noise)],
        rotations.rigid_fit(vertices, noise),
    )
    yield rotations.turned_quaternions(turns, poses[2, :3, :3])
    moved = vertices @ poses[2, :3, :3] + noise
    yield rotations.smooth_displacement(vertices, moved, lambda beside: beside.sort(0))
    yield triangles.pseudonormals(vertices, few, faces_across(few))
    near = np.empty((162, 3))
    steps = np.empty((2, 162))
    away = np.empty(162)
    winding = np.empty(162)
    for x, out in zip(3.0 * noise, near):
        triangles.nearest_weights(x, *np.diag([1.0, 2.0, 0.6]), out)
    surfaces.touching_balls(vertices, surfaces.vertex_normals(vertices, faces), steps, away)
    winding_loop(vertices, faces[:300], noise, winding)
    yield near, steps, away, winding, surfaces.volume_cubic(vertices, faces, noise)
    yield (
        surfaces.barycentric_weights(noise, vertices[faces[:162]]),
        surfaces.vertex_areas(vertices, faces),
    )
    line, places = np.cumsum(np.abs(noise[:9]), axis=0), np.linspace(-1.0, 9.0, 20)
    yield tubes.tube_mesh(line, np.linspace(1.0, 2.0, 9)), tubes.points_along(line, places)
    pinched = np.where(faces == 9, 0, faces)
    yield coarse.clustered(vertices, faces, 150), surfaces.split_pinched_vertices(vertices, pinched)
    frame = BoneFrame(vertices + 0.1 * noise)
    yield frame.axes, frame.local, frame.box([[-1, -2, 0], [1, 1, 2]]), frame.placed(poses[2])
    yield moved_box(np.sort(noise[:2], axis=0), poses)
    weight, slope = np.empty((2, 3, 4))
    for t, *one in zip((0.1, 0.5, 0.8), weight, slope):
        bsplines.bspline_weights(t, *one)
    yield (
        weight,
        slope,
        bsplines.bspline_sum(noise[:144].reshape(6, 8, 9), (1, 2, 3), weight, slope),
    )


def _lattice():
    lattice, points = Lattice(*ball((3.0, 2.0, 1.2), bumps=0.1), 60), ball((5.0, 3.0, 2.0))[0]
    yield {key: value for key, value in vars(lattice).items() if isinstance(value, np.ndarray)}
    yield lattice.embed(points), lattice.regions(5), lattice.second_differences()
    lines = [np.cumsum(points[k : k + 9], axis=0)[:: 1 - 2 * (k % 2)] for k in (0, 33, 70, 111)]
    yield fibre_directions(points, points, lines, fallback=points[0])


PARTS = {"bones": _bones, "fields": _fields, "surfaces": _surfaces, "lattice": _lattice}


@pytest.mark.parametrize("name", PARTS)
def test_part_gives_what_is_kept(name):
    # Fits of a condition of 1e10 keep six digits.
    check_kept(f"part_{name}", list(PARTS[name]()), tolerance=1e-5 if name == "fields" else 1e-9)
