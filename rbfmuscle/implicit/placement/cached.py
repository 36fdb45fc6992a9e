"""Samples of a surface, kept on disk."""

from dataclasses import asdict

import numpy as np

from rbfmuscle.cache import content_key, load_arrays, store_arrays
from rbfmuscle.geometry.crossing import morton_order
from rbfmuscle.geometry.surfaces import vertex_normals
from rbfmuscle.implicit.placement.sampling import SurfaceSample, sample_surface

# Part of the names under which samples are kept: raise it when the way to find them changes.
SAMPLING = 5
SEED = 0


def cached_sample(
    vertices: np.ndarray, faces: np.ndarray, count: int, placement: str
) -> SurfaceSample:
    """`sample_surface` of a muscle's mesh, from the cache on disk by content: greedy placement
    takes a second.

    Points are in an order in which near ones are mostly near each other, except for greedy
    placement. A mesh of ``count`` vertices is its own even sample.
    """
    if placement == "even" and len(vertices) == count:
        normals = vertex_normals(vertices, faces)
        return SurfaceSample(vertices, normals, np.ascontiguousarray(faces, dtype=np.int64))
    key = content_key(vertices, faces, ("surface sample", SAMPLING, count, SEED, placement))
    arrays = load_arrays(key)
    if arrays is None:
        arrays = asdict(sample_surface(vertices, faces, count, seed=SEED, placement=placement))
        if placement != "greedy":
            order = morton_order(arrays["points"])
            corners = np.argsort(order)[arrays.pop("control_faces")]
            arrays = {name: part[order] for name, part in arrays.items()} | {
                "control_faces": corners
            }
        store_arrays(key, arrays)
    return SurfaceSample(**arrays)
