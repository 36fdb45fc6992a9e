"""Fibres at rest in bars, bent and pennate muscles whose lines of flux are known."""

import numpy as np
import pytest
import trimesh

from rbfmuscle.fibres import FluxField, trace_fibres
from rbfmuscle.geometry.mesh_distance import MeshDistance
from rbfmuscle.scene.bone import BoneDistance

LENGTH, SIDE = 60.0, 12.0


def bar():
    """A box from 0 to LENGTH along x, finely divided, as vertices and faces."""
    mesh = trimesh.creation.box((LENGTH, SIDE, SIDE))
    while mesh.edges_unique_length.max() > 4.0:
        mesh = mesh.subdivide()
    vertices = np.array(mesh.vertices)
    vertices[:, 0] += 0.5 * LENGTH
    return vertices, np.array(mesh.faces)


def grid(low, high, axis, at, count=30):
    """Points evenly over a rectangle across an axis."""
    a, b = (np.linspace(low[k], high[k], 2 * count + 1)[1::2] for k in range(2))
    plane = np.stack(np.meshgrid(a, b), axis=-1).reshape(-1, 2)
    return np.insert(plane, axis, at, axis=1)


def caps():
    half = 0.5 * SIDE
    return tuple(grid((-half, -half), (half, half), 0, x) for x in (0.0, LENGTH))


def test_fibres_of_a_straight_bar_are_straight_and_even():
    lines, ends = trace_fibres(MeshDistance(*bar()), caps(), 32)
    assert len(lines) == 32
    # Near the caps flux enters by cells of 0.7 mm, and lines end on points 0.4 mm apart.
    assert np.ptp(lines[:, 2:-2, 1:], axis=1).max() < 0.2
    assert np.ptp(lines[:, :, 1:], axis=1).max() < 0.7
    assert np.abs(lines[:, [0, -1], 0] - [0.0, LENGTH]).max() < 1e-9
    assert np.allclose(lines[:, 0], caps()[0][ends[:, 0]])
    middle = lines[:, 12, 1:]
    quadrant = 2 * (middle[:, 0] > 0) + (middle[:, 1] > 0)
    assert np.bincount(quadrant, minlength=4).min() >= 4  # of 32
    # Evenly spread over the section, each coordinate has the mean and the spread of a uniform one.
    assert np.abs(middle.mean(axis=0)).max() < 0.1 * SIDE
    assert middle.std(axis=0) == pytest.approx(SIDE / np.sqrt(12), rel=0.1)


def test_fibres_of_a_bent_bar_are_arcs():
    radius, turn = 30.0, 0.5 * np.pi

    def bent(points):
        angle = points[:, 0] / LENGTH * turn
        r = radius + points[:, 1]
        return np.stack([r * np.sin(angle), r * np.cos(angle), points[:, 2]], axis=1)

    vertices, faces = bar()
    ends = tuple(bent(end) for end in caps())
    mesh = MeshDistance(bent(vertices), faces)
    lines, _ = trace_fibres(mesh, ends, 24)
    r = np.hypot(lines[:, :, 0], lines[:, :, 1])
    # Flux that enters evenly over a cap and flows as 1 / r moves outwards by 0.7 mm near the caps.
    assert np.ptp(r[:, 3:-3], axis=1).max() < 0.6
    lengths = np.linalg.norm(np.diff(lines, axis=1), axis=2).sum(axis=1)
    assert lengths == pytest.approx(turn * r.mean(axis=1), rel=0.01)
    assert (mesh.signed(lines[:, 1:-1].reshape(-1, 3)) < 0.0).all()


def angles(lines, direction):
    """Between the chords of lines and a direction [degree]."""
    ahead = lines[:, -1] - lines[:, 0]
    return np.degrees(np.arccos(ahead @ direction / np.linalg.norm(ahead, axis=1)))


def test_fibres_between_two_aponeuroses_follow_polylines():
    direction = np.array([1.0, 1.0, 0.0]) / np.sqrt(2.0)
    half = 0.5 * SIDE
    ends = tuple(grid((0.0, -half), (LENGTH, half), 1, y) for y in (-half, half))
    starts = grid((0.0, -half), (LENGTH, half), 1, -half, count=10)
    polylines = [start + np.linspace(-5.0, 35.0, 20)[:, None] * direction for start in starts]
    mesh = MeshDistance(*bar())
    lines, _ = trace_fibres(mesh, ends, 20, polylines=polylines)
    # Two corners of the bar, a fifth of it, are reached from one aponeurosis only.
    # Of the others the ends may lie 1 mm away, which are 17 mm apart.
    assert np.percentile(angles(lines, direction), 70) < 5.0
    fine = tuple(grid((0.0, -half), (LENGTH, half), 1, y, count=120) for y in (-half, half))
    free, _ = trace_fibres(mesh, fine, 20)
    # Lines end on points 0.5 mm apart, 12 mm from each other; between two of them either is taken.
    assert angles(free, direction) == pytest.approx(45.0, abs=2.5)


def test_fibres_of_a_feather_have_its_pennation_angle():
    pennation = np.radians(25.0)
    vertices, faces = bar()
    lean = np.array([1.0 / np.tan(pennation), 0.0, 0.0])
    half = 0.5 * SIDE
    ends = [grid((0.0, -half), (LENGTH, half), 1, y, count=120) for y in (-half, half)]
    sheared = MeshDistance(vertices + vertices[:, [1]] * lean, faces)
    lines, _ = trace_fibres(sheared, tuple(end + end[:, [1]] * lean for end in ends), 32)
    # Even flux along the sloping ends has no divergence and passes no wall: it is the solution.
    direction = np.array([np.cos(pennation), np.sin(pennation), 0.0])
    assert angles(lines, direction).max() < 2.0
    lengths = np.linalg.norm(np.diff(lines, axis=1), axis=2).sum(axis=1)
    assert lengths.mean() == pytest.approx(SIDE / np.sin(pennation), rel=0.005)
    # Either end is found within a cell of 0.7 mm.
    assert lengths == pytest.approx(SIDE / np.sin(pennation), abs=1.5)


def test_fibres_stay_in_the_muscle_and_out_of_bones():
    ball = trimesh.creation.icosphere(4, 4.0)
    ball.apply_translation([0.5 * LENGTH, -0.5 * SIDE, 0.0])
    probe = BoneDistance("ball", ball)
    mesh = MeshDistance(*bar())
    lines, _ = trace_fibres(mesh, caps(), 40, bones=[probe])
    inner = lines[:, 1:-1].reshape(-1, 3)
    assert probe.depth(inner).max() < 1e-6
    assert mesh.signed(inner).max() < 0.0
    through, _ = trace_fibres(mesh, caps(), 40)
    assert probe.depth(through.reshape(-1, 3)).max() > 0.5


def test_flux_goes_from_the_origin_to_the_insertion_and_is_kept():
    vertices, faces = bar()
    field = FluxField(MeshDistance(vertices, faces), caps())
    flow = field(np.array([[x, y, 0.0] for x in (10.0, 30.0, 50.0) for y in (-3.0, 0.0, 3.0)]))
    # The cells of the walls reach beyond the bar: 19 cells for 18.2.
    assert flow[:, 0] == pytest.approx(1.0 / SIDE**2, rel=0.1)
    assert np.abs(flow[:, 1:]).max() < 0.01 * flow[:, 0].min()


def test_separate_pieces_have_no_fibres():
    vertices, faces = bar()
    both = np.concatenate([vertices, vertices + [0.0, 40.0, 0.0]])
    mesh = MeshDistance(both, np.concatenate([faces, faces + len(vertices)]))
    origin, insertion = caps()
    with pytest.raises(np.linalg.LinAlgError, match="separate pieces"):
        trace_fibres(mesh, (origin, insertion + [0.0, 40.0, 0.0]), 8)
