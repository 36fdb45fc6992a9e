"""What a fold of the field or the edge of a bone has turned inside out is closed over and smoothed."""

import numpy as np

from rbfmuscle.geometry.arrays import Booleans, Integers
from rbfmuscle.implicit.extraction.carried_material import CarriedMaterial

# Rounds of smoothing for triangles that cross others, and how the smoothed region grows with them.
UNTANGLE, GROWTH = 24, 4
# Rounds before them in which what crosses is taken back to where the material is, by this share of the way.
RETURN, BACK = 12, 0.15
# The share of its slope at rest below which a field may show two sheets.
SUNK_SLOPE = 0.7
# What is sunk in a bone, or what a bone sent so many mean edges away, is drawn as a skin over the place where it goes
# in: so many sweeps of smoothing first, and in each of some rounds after, each followed by the way out of the bone.
STRAYED = 1.5
FILL_SWEEPS, GATHER, GATHER_SWEEPS = 150, 4, 12


def gather(material: CarriedMaterial) -> None:
    """Close the surface over what is deep in a bone: a sheet that is folded over it would cross itself."""
    projector = material.projector
    away = projector.vertices - material.carried
    strayed = np.einsum("nd,nd->n", away, away) > (STRAYED * material.edge) ** 2
    lost = np.asarray(material.sunk | strayed, dtype=np.bool_)
    if not lost.any():
        return
    rows = np.flatnonzero(material.mesh.around(lost, 1))
    for turn in range(GATHER):
        material.mesh.smooth(projector.vertices, rows, GATHER_SWEEPS if turn else FILL_SWEEPS)
        if material.field is None:
            material.lift(rows)
            continue
        part = projector.part(rows)
        part.project(material.level)
        projector.take(part, rows)


def untangle(material: CarriedMaterial) -> int:
    """Smooth what crosses itself; return how many vertices were moved for it."""
    projector, faces = material.projector, material.mesh.faces
    touched = np.zeros(len(material.carried), dtype=np.bool_)
    among = _suspicious(material)
    for turn in range(0 if material.field is None else -RETURN, UNTANGLE + 1):
        # What was not moved does not begin to cross.
        bad = material.mesh.tree.crossing(projector.vertices, among)
        if turn == UNTANGLE or not bad.any():
            break
        marked = np.zeros(len(material.carried), dtype=np.bool_)
        marked[faces[bad].ravel()] = True
        region = material.mesh.around(marked, 1 + max(turn, 0) // GROWTH)
        among = np.asarray(region[faces].any(axis=1), dtype=np.bool_)
        touched |= region
        if turn < 0:
            _return(material, np.flatnonzero(region))
        else:
            _smooth(material, np.flatnonzero(region), material.field is not None and turn < UNTANGLE // 2)
    return int(touched.sum())


def _suspicious(material: CarriedMaterial) -> Booleans | None:
    """Mask of the triangles that may cross others without being folded at a corner; None where it can be any.

    These are where the field's slope has sunk, as between sheets that met, and what was held back, sunk or pushed.
    """
    projector, rest = material.projector, material.mesh.slope
    if material.field is None or rest is None:
        return None
    odd = material.sunk | material.pushed | material.left | (SUNK_SLOPE * projector.slope * rest >= 1.0)
    found: Booleans = np.asarray(odd[material.mesh.faces].any(axis=1), dtype=np.bool_)
    return found


def _return(material: CarriedMaterial, rows: Integers) -> None:
    """Take vertices back towards where the material is, which smoothing would shorten; not those on bones."""
    projector = material.projector
    away = projector.vertices[rows] - material.carried[rows]
    strayed = np.einsum("nd,nd->n", away, away) > (STRAYED * material.edge) ** 2
    free = projector.on_field[rows] & ~strayed & ~material.pushed[rows]
    projector.vertices[rows[free]] -= BACK * away[free]
    material.lift(rows[free])


def _smooth(material: CarriedMaterial, rows: Integers, onto_field: bool) -> None:
    """Move vertices towards their neighbours, then back onto the surface, or out of the bones at least."""
    projector = material.projector
    before = projector.vertices[rows]
    material.mesh.smooth(projector.vertices, rows, 3)
    if not onto_field:
        material.lift(rows)
        return
    part = projector.part(rows)
    part.project(material.level)
    gone = np.einsum("nd,nd->n", part.vertices - before, part.vertices - before) > material.edge**2
    part.vertices[gone] = projector.vertices[rows[gone]]
    projector.take(part, rows)
