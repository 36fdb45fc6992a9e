"""Errors against answers in closed form, and orders of convergence."""

import math

import numpy as np

from rbfmuscle.geometry.surfaces import mesh_volume
from rbfmuscle.metrics.centreline import Centreline

# Points of a centreline: their chords fall short of an arc of 90 degrees by 0.01 %.
SLICES = 64
# Points of a strip nearer to the bone than this [mm] count as touching it.
TOUCH = 0.1
# A sequence that converges more slowly says nothing about its limit.
LEAST_ORDER = 0.2


def section(vertices, faces, point, normal):
    """Area and centroid of a closed mesh cut by a plane.

    Parameters
    ----------
    vertices : (n, 3) ndarray
    faces : (m, 3) ndarray of int
        Closed, outward.
    point, normal : (3,) array_like
        Of the plane.

    Returns
    -------
    area : float
    centroid : (3,) ndarray
        Of the area; NaN where the plane misses the mesh.
    """
    normal = np.asarray(normal, dtype=float) / np.linalg.norm(normal)
    point = np.asarray(point, dtype=float)
    height = (vertices - point) @ normal
    above = height[faces] > 0.0
    cut = above.any(axis=1) & ~above.all(axis=1)
    crossed, above = faces[cut], above[cut]
    lone = np.where(above.sum(axis=1) == 1, above.argmax(axis=1), (~above).argmax(axis=1))
    row = np.arange(len(crossed))
    a, b, c = (crossed[row, (lone + k) % 3] for k in range(3))
    p, q = (
        vertices[a]
        + (height[a] / (height[a] - height[o]))[:, None] * (vertices[o] - vertices[a])
        - point
        for o in (b, c)
    )
    # The outline runs anticlockwise about the normal where the lone corner is above it.
    flip = ~above[row, lone]
    p[flip], q[flip] = q[flip], p[flip]
    twice = np.cross(p, q) @ normal
    area = 0.5 * twice.sum()
    with np.errstate(invalid="ignore"):
        centroid = (
            (twice[:, None] * (p + q)).sum(axis=0) / 6.0 / area
            if len(twice)
            else np.full(3, np.nan)
        )
    return float(abs(area)), point + centroid


def centreline(muscle, scene, rest, carried, poses):
    """Points (SLICES + 2, 3) of a muscle's centreline, ends included.

    Parameters
    ----------
    muscle : Muscle
    scene : Scene
    rest, carried : (vertices, faces)
        A model's material surface at rest and now.
    poses : dict of str to (4, 4) ndarray
    """
    return Centreline(muscle, scene.joints, *rest, slices=SLICES).points(carried[0], poses)


def path_length(points):
    """Length of a polyline."""
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def observed_order(sizes, errors):
    """Exponent p of error = c size^p, by least squares in logarithms.

    Parameters
    ----------
    sizes, errors : (n,) array_like
        Spacings and errors, in any order; signs of the errors do not count.

    Returns
    -------
    float
        NaN where an error is zero.
    """
    errors = np.abs(np.asarray(errors, dtype=float))
    if (errors <= 0.0).any() or len(errors) < 2:
        return math.nan
    return float(np.polyfit(np.log(sizes), np.log(errors), 1)[0])


def richardson(sizes, values):
    """Order and limit of the last three of a sequence: value = limit + c size^p (Richardson 1911).

    Parameters
    ----------
    sizes, values : (n,) array_like
        Spacings from coarse to fine, and what came out.

    Returns
    -------
    order, limit : float
        NaN where the differences change sign or hardly shrink: the sequence is not in its
        asymptotic range.
    """
    h, v = np.asarray(sizes, dtype=float)[-3:], np.asarray(values, dtype=float)[-3:]
    coarse, fine = v[0] - v[1], v[1] - v[2]
    if fine == 0.0 or coarse / fine <= 0.0:
        return math.nan, math.nan
    wanted = coarse / fine

    def ratio(p):
        return (h[0] ** p - h[1] ** p) / (h[1] ** p - h[2] ** p)

    low, high = LEAST_ORDER, 20.0
    if not ratio(low) < wanted < ratio(high):
        return math.nan, math.nan
    from scipy.optimize import brentq

    order = brentq(lambda p: ratio(p) - wanted, low, high)
    return float(order), float(v[2] - fine * h[2] ** order / (h[1] ** order - h[2] ** order))


def stretched_bar_errors(stretch, bar, rest, frame):
    """Relative errors of a pulled bar (`peers.known_scenes.stretched_bar`).

    Parameters
    ----------
    stretch : float
        Between the held ends.
    bar : peers.known_scenes.Bar
    rest : (vertices, faces)
        The model's material surface at rest.
    frame : rbfmuscle.simulation.frame_loop.Frame
        With a surface.

    Returns
    -------
    dict of str to float
        ``radius``: of the middle half against r / sqrt(stretch of the material there);
        ``radius_ends``: against r / sqrt(stretch between the ends); ``waviness``: spread of the
        radius over the middle half; ``path``: of the carried middle against the distance of the
        ends; ``volume``: of the surface against the closed form.
    """
    name = next(iter(frame.surfaces))
    skin, (places, _) = frame.surfaces[name], frame.material_meshes[name]
    start, length = -0.5 * bar.length, stretch * bar.length
    stations = start + length * np.linspace(0.25, 0.75, 21)
    found = [section(skin.vertices, skin.faces, (x, 0, 0), (1, 0, 0)) for x in stations]
    radii = np.sqrt([area / np.pi for area, _ in found])
    middle = np.abs(rest[0][:, 0]) < 0.25 * bar.length
    inner = np.polyfit(rest[0][middle, 0], places[middle, 0], 1)[0]
    line = np.array([centroid for _, centroid in found])
    return {
        "radius": radii.mean() * math.sqrt(inner) / bar.thickness - 1.0,
        "radius_ends": radii.mean() * math.sqrt(stretch) / bar.thickness - 1.0,
        "waviness": (radii.max() - radii.min()) / radii.mean(),
        "path": path_length(line) / (0.5 * length) - 1.0,
        "volume": _volume(skin) / bar.volume - 1.0,
    }


def bent_bar_errors(angle, bar, line_rest, line, frame):
    """Relative errors of a bent bar (`peers.known_scenes.bent_bar`).

    Parameters
    ----------
    angle : float
        Between the ends [radian].
    bar, frame
        As for `stretched_bar_errors`.
    line_rest, line : (k, 3) ndarray
        Its `centreline` at rest and now.

    Returns
    -------
    dict of str to float
        ``path``: length of the centreline against that at rest; ``arc``: mean radius of the
        centreline against length / angle; ``radius``: of the sections in the middle half;
        ``volume``.
    """
    (skin,) = frame.surfaces.values()
    radius = bar.length / angle
    centre = np.array([-0.5 * bar.length, 0.0, -radius])
    offset = line - centre
    turned = np.arctan2(offset[:, 0], offset[:, 2])
    between = (turned > 0.02 * angle) & (turned < 0.98 * angle)
    radii = []
    for q in angle * np.linspace(0.25, 0.75, 9):
        out, along = (
            np.array([math.sin(q), 0, math.cos(q)]),
            np.array([math.cos(q), 0, -math.sin(q)]),
        )
        radii.append(
            math.sqrt(section(skin.vertices, skin.faces, centre + radius * out, along)[0] / math.pi)
        )
    return {
        "path": path_length(line) / path_length(line_rest) - 1.0,
        "arc": np.hypot(offset[between, 0], offset[between, 2]).mean() / radius - 1.0,
        "radius": np.mean(radii) / bar.thickness - 1.0,
        "volume": _volume(skin) / bar.volume - 1.0,
    }


def wrapped_strip_errors(angle, over, added, lifted, bone_radius, line_rest, line, places):
    """Relative errors of a wrapped strip (`peers.known_scenes.wrapped_strip`).

    Parameters
    ----------
    angle : float
        Of the turn [radian].
    over : {"cylinder", "sphere"}
    added, lifted : float
        The closed form: length added to the path, radius of the centreline on the bone.
    bone_radius : float
    line_rest, line : (k, 3) ndarray
        The strip's `centreline` at rest and now.
    places : (n, 3) ndarray
        The model's material surface now.

    Returns
    -------
    dict of str to float
        ``path``, ``radius`` (of the centreline in the middle half of the arc), ``contact`` (arc in
        contact; -1 where nothing touches).

    Notes
    -----
    Points nearer than ``TOUCH`` count as touching. A straight line that leaves the bone stays that
    near for another arccos(R / (R + TOUCH)) at each end, which is taken off.
    """
    turned = np.arctan2(line[:, 0], line[:, 2])
    middle = np.abs(turned - 0.5 * angle) < 0.25 * angle
    radius = np.hypot(line[middle, 0], line[middle, 2]).mean() if middle.any() else math.nan
    away = (
        np.hypot(places[:, 0], places[:, 2])
        if over == "cylinder"
        else np.linalg.norm(places, axis=1)
    )
    touching = places[away < bone_radius + TOUCH]
    touched = 0.0
    if len(touching):
        touched = np.ptp(np.arctan2(touching[:, 0], touching[:, 2]))
        touched -= 2.0 * math.acos(bone_radius / (bone_radius + TOUCH))
    return {
        "path": path_length(line) / (path_length(line_rest) + added) - 1.0,
        "radius": radius / lifted - 1.0,
        "contact": max(0.0, float(touched)) / angle - 1.0,
    }


def _volume(skin):
    return mesh_volume(skin.vertices, np.asarray(skin.faces))
