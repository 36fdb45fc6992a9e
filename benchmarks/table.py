"""One table of ratios against other libraries: ``make bench``.

Each row times the same work done by us and by a peer, in one process, in turns, and keeps the least of several
rounds: on a shared machine ratios hold, milliseconds do not. Peers that are not installed are named as missing.
"""

import argparse
import importlib
import json
import os
import platform
import time
from importlib import metadata
from pathlib import Path

import numpy as np

from rbfmuscle.implicit.extraction.surface import extract_surface
from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.placement.sampling import sample_surface
from rbfmuscle.sim.distance.sdf import BoneSDF
from rbfmuscle.sim.scene.phantom import phantom_scene
from rbfmuscle.sim.scene.scene import Scene

PEERS = ("scipy", "libigl", "trimesh", "pyPBD", "PyMCubes", "vtk", "scikit-image")
MODULES = {"libigl": "igl", "PyMCubes": "mcubes", "pyPBD": "pypbd", "scikit-image": "skimage"}
ROUNDS = 5


def machine():
    """What the figures hold for."""
    model = platform.processor()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [
            line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if "model name" in line
        ]
        model = names[0] if names else model
    versions = {name: version(name) for name in ("numpy", "numba", "rbfmuscle", *PEERS)}
    import numba

    return {
        "cpu": model, "cores": os.cpu_count(), "usable_cores": len(os.sched_getaffinity(0)),
        "threads": numba.get_num_threads(), "system": platform.platform(), "python": platform.python_version(),
        "versions": versions,
    }  # fmt: skip


def version(name):
    """Installed version of a distribution, or None."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def peer(name):
    """A peer's module, or None where it is not installed."""
    try:
        return importlib.import_module(MODULES.get(name, name))
    except ImportError:
        return None


def least_times(*works):
    """Least time [s] of each piece of work, run in turns; the first turn warms up."""
    best = [np.inf] * len(works)
    for turn in range(ROUNDS + 1):
        for k, work in enumerate(works):
            start = time.perf_counter()
            work()
            if turn:
                best[k] = min(best[k], time.perf_counter() - start)
    return best


class Table:
    """Rows of the table, printed as they come."""

    def __init__(self):
        self.rows = []
        print(f"{'scene':10}{'work':46}{'ours ms':>9}  {'peer':28}{'ms':>9}{'ratio':>8}", flush=True)

    def add(self, scene, work, other, ours, theirs, *, apart=False):
        """Time ``ours`` against ``theirs``; a peer that is missing gives a row that says so.

        ``apart`` times all rounds of one, then of the other: BLAS threads of a peer go on waiting on the cores for
        some 20 ms after their work, which would be counted to ours.
        """
        if theirs is None:
            self.rows.append({"scene": scene, "work": work, "peer": other, "missing": True})
            print(f"{scene:10}{work:46}{'':>9}  {other + ': not installed':28}", flush=True)
            return
        mine, yours = (least_times(ours) + least_times(theirs)) if apart else least_times(ours, theirs)
        self.keep(scene, work, other, mine, yours)

    def keep(self, scene, work, other, mine, yours):
        """Keep and print a row of two times [s]."""
        row = {
            "scene": scene,
            "work": work,
            "peer": other,
            "ours": mine,
            "theirs": yours,
            "ratio": yours / mine,
        }
        self.rows.append(row)
        print(
            f"{scene:10}{work:46}{1e3 * mine:9.2f}  {other:28}{1e3 * yours:9.2f}{yours / mine:8.2f}",
            flush=True,
        )


def bench_fields(table, name, mesh, count):
    """Fit and evaluation against SciPy, extraction against the marching cubes of others."""
    from scipy.interpolate import RBFInterpolator

    sample = sample_surface(np.asarray(mesh.vertices), np.asarray(mesh.faces), count)
    outside = sample.points + 2.0 * sample.normals
    points = np.concatenate([sample.points, outside])
    values = np.concatenate([np.zeros(count), np.full(count, 2.0)])
    queries = np.random.default_rng(0).uniform(*mesh.bounds, (20_000, 3))
    ours = RBFField.fit(points, values, kernel="cubic", degree=1)
    scipy = RBFInterpolator(points, values, kernel="cubic", degree=1)
    apart = np.abs(ours(queries) - scipy(queries)).max() / np.ptp(values)
    if apart > 1e-6:
        raise SystemExit(f"SciPy and we differ by {apart:.1e}: the rows would compare different things")
    table.add(name, f"fit values, cubic, {2 * count} points", "SciPy RBFInterpolator",
              lambda: RBFField.fit(points, values, kernel="cubic", degree=1),
              lambda: RBFInterpolator(points, values, kernel="cubic", degree=1))  # fmt: skip
    table.add(name, f"evaluate 20000 points x {2 * count} centres", "SciPy RBFInterpolator",
              lambda: ours(queries), lambda: scipy(queries), apart=True)  # fmt: skip
    bench_extraction(table, name, RBFField.fit_hermite(sample.points, sample.normals), sample)


def bench_extraction(table, name, field, sample):
    """Our band against a dense grid: evaluation included on both sides, as a muscle needs both."""
    low, high = sample.points.min(axis=0), sample.points.max(axis=0)
    cell = (high - low).max() / 48
    axes = [np.arange(a - 3 * cell, b + 3 * cell, cell) for a, b in zip(low, high)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    shape = grid.shape[:3]

    def dense():
        return field(grid.reshape(-1, 3)).reshape(shape)

    def band():
        return extract_surface(field, points=sample.points, resolution=48)

    volume = dense()
    work = "evaluate and extract, 48 cells, projected"
    skimage, cubes, vtk = peer("scikit-image"), peer("PyMCubes"), peer("vtk")
    table.add(name, work, "scikit-image, dense grid", band,
              skimage and (lambda: _skimage(dense())))  # fmt: skip
    table.add(
        name, work, "PyMCubes, dense grid", band, cubes and (lambda: cubes.marching_cubes(dense(), 0.0))
    )
    image = vtk and _image(volume)
    table.add(
        name, work, "VTK flying edges, dense grid", band, vtk and (lambda: (dense(), _flying_edges(image)))
    )


def _skimage(volume):
    from skimage.measure import marching_cubes

    return marching_cubes(volume, 0.0)


def _image(volume):
    import pyvista

    image = pyvista.ImageData(dimensions=volume.shape)
    image.point_data["value"] = volume.ravel(order="F")
    return image


def _flying_edges(image):
    return image.contour([0.0], scalars="value", method="flying_edges", compute_normals=False)


def bench_distance(table, name, mesh):
    """A bone's distance field against exact distances."""
    rng = np.random.default_rng(0)
    vertices, faces = np.ascontiguousarray(mesh.vertices, float), np.ascontiguousarray(mesh.faces, np.int64)
    near = vertices[rng.integers(len(vertices), size=5000)] + rng.normal(size=(5000, 3))
    field = BoneSDF.from_mesh(mesh)
    igl, trimesh = peer("libigl"), peer("trimesh")
    few = near[:500]
    work = "signed distance, 5000 points within 1 to 3 mm"
    table.add(name, work, "libigl, pseudonormals", lambda: field.distance(near),
              igl and (lambda: _igl_distance(igl, near, vertices, faces)))  # fmt: skip
    table.add(name, "the same, 500 points", "trimesh", lambda: field.distance(few),
              trimesh and (lambda: trimesh.proximity.signed_distance(mesh, few)))  # fmt: skip


def _igl_distance(igl, points, vertices, faces):
    return igl.signed_distance(points, vertices, faces, sign_type=igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL)


def bench_deformation(table, name, scene, muscle):
    """One frame of the mesh muscle against pyPBD's distance constraints and libigl's ARAP iterations."""
    from rbfmuscle.models import build_model
    from rbfmuscle.sim.loop.driving.live import LiveSession

    alone = scene.copy()
    alone.muscles = [scene.muscle(muscle)]
    sessions = {}
    for model in ("rbf", "pbd"):
        sessions[model] = LiveSession(alone)
        sessions[model].use([build_model(alone.muscles[0], alone, model)])
    coordinate = next(iter(sessions["rbf"].limits))
    igl, pbd = peer("libigl"), peer("pyPBD")
    mesh = alone.muscles[0].mesh

    def turn(session):
        session.set(coordinate, 0.035 - session.here[coordinate])
        session.advance()

    arap = igl and _arap(igl, mesh)
    for model, session in sessions.items():
        table.add(name, f"{model}: 2 degrees solved, surface extracted", "libigl ARAP, 5 iterations",
                  lambda session=session: turn(session), arap)  # fmt: skip
        table.add(name, f"{model}: 2 degrees solved, surface extracted", "pyPBD, distances alone, 5",
                  lambda session=session: turn(session), pbd and _pbd(pbd, mesh))  # fmt: skip
        session.close()


def _arap(igl, mesh):
    vertices, faces = np.ascontiguousarray(mesh.vertices, float), np.ascontiguousarray(mesh.faces, np.int64)
    ends = np.r_[np.argsort(vertices[:, 2])[:50], np.argsort(vertices[:, 2])[-50:]].astype(np.int64)
    moved = vertices[ends] + np.where(np.arange(100) < 50, 3.0, 0.0)[:, None]
    if not hasattr(igl, "ARAPData"):
        return None
    data = igl.ARAPData()
    data.max_iter = 5
    igl.arap_precomputation(vertices, faces, 3, ends, data)
    return lambda: igl.arap_solve(moved, data, vertices.copy())


def _pbd(pbd, mesh):
    simulation = pbd.Simulation.getCurrent()
    simulation.initDefault()
    model = simulation.getModel()
    model.addTriangleModel(np.asarray(mesh.vertices, float), np.asarray(mesh.faces).ravel().tolist())
    cloth = model.getTriangleModels()[-1]
    model.addClothConstraints(cloth, 1, 1.0, 1.0, 1.0, 1.0, 0.3, 0.3, False, False)
    step = pbd.TimeManager.getCurrent()
    step.setTimeStepSize(0.005)
    stepper = simulation.getTimeStep()
    stepper.setValueUInt(pbd.TimeStepController.NUM_SUB_STEPS, 1)
    stepper.setValueUInt(pbd.TimeStepController.MAX_ITERATIONS, 5)
    return lambda: stepper.step(model)


def scenes():
    """The phantom, and the real hip where it is present: name, scene, muscle, centres, bone."""
    yield "phantom", phantom_scene(), "extensor", 150, "femur"
    places = [os.environ.get("RBFMUSCLE_DATA"), Path(__file__).resolve().parents[2] / "shared" / "data"]
    hip = next((Path(p) / "hip" for p in places if p and (Path(p) / "hip").is_dir()), None)
    if hip is None:
        print("the real hip is not here (set RBFMUSCLE_DATA to the folder that holds hip/)")
        return
    yield "real hip", Scene.load(hip / "flexion.toml"), "gluteus_maximus", 300, "femur"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("benchmarks/last.json"))
    parser.add_argument("--scene", choices=["phantom", "real hip"])
    chosen = parser.parse_args()
    about = machine()
    print(f"{about['cpu']}, {about['usable_cores']} of {about['cores']} cores, {about['threads']} threads")
    print("ratio: how many times longer the peer takes")
    table = Table()
    for name, scene, muscle, count, bone in scenes():
        if chosen.scene in (None, name):
            bench_fields(table, name, scene.muscle(muscle).mesh, count)
            bench_distance(table, name, scene.bone(bone).mesh)
            bench_deformation(table, name, scene, muscle)
    chosen.output.write_text(json.dumps({"machine": about, "rows": table.rows}, indent=1), encoding="utf-8")
    missing = [name for name in PEERS if about["versions"][name] is None]
    print(f"written to {chosen.output}" + (f"; not installed: {', '.join(missing)}" if missing else ""))


if __name__ == "__main__":
    main()
