"""What several test files share."""

import hashlib
import itertools
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent

# The threads of BLAS spin while they wait: beside another worker, or on a busy machine, they take
# the cores from what they wait for, at two to six times the processor time. Loops keep theirs, so
# what runs side by side is tested as such.
for _name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

# A job that a script starts in the background ignores interrupts, as would all that tests start.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Numba sees edits of a loop in its own file alone, not in those of the loops that it calls: tests
# keep the code of each state of the sources apart.
_sources = hashlib.sha256()
for _file in sorted([*ROOT.glob("rbfmuscle/**/*.py"), *ROOT.glob("pbd_baseline/*.py")]):
    _sources.update(_file.read_bytes())
_loops = ROOT / ".pytest_cache" / "loops" / _sources.hexdigest()[:16]
os.environ.setdefault("NUMBA_CACHE_DIR", str(_loops))

# Seed of moves at random of the vertices of every scene, and of the shapes that tests make; 0 is
# none. They are moved by this share of their size, more than what another processor rounds
# otherwise: a test that fails then hangs on last digits (make portability).
SEED = int(os.environ.get("RBFMUSCLE_MOVED_VERTICES", "0"))
MOVED = 1e-12

# Folders of tests whose results depend on floating point, beside files that mark themselves so.
NUMERIC = (
    *("bones", "fibres", "geometry", "implicit", "metrics"),
    *("muscle", "pbd", "simulation", "solid", "surface"),
)


# Folders of tests that between them compile almost every loop.
COMPILING = ("cli", "contract", "fibres", "muscle", "studies")


def pytest_collection_modifyitems(items):
    """Begin with what compiles: of two workers, which begin with a half of the tests each, one then
    compiles and the other finds the code in the cache, where else both would compile it.
    """
    items.sort(key=lambda item: item.path.parent.name not in COMPILING)


def pytest_itemcollected(item):
    """Mark the tests that CI runs under other roundings."""
    if item.path.parent.name in NUMERIC:
        item.add_marker("numeric")


def _moved(vertices):
    import numpy as np  # behind the numbers of threads

    vertices = np.array(vertices, dtype=float)
    step = MOVED * np.linalg.norm(np.ptp(vertices, axis=0))
    return vertices + step * np.random.default_rng(SEED).uniform(-1.0, 1.0, vertices.shape)


def _move_vertices():
    import numpy as np
    import trimesh

    from rbfmuscle.scene.meshes import read as meshes

    def prepared(vertices, faces, prepare=meshes.prepare_mesh, **named):
        sound = np.ndim(vertices) == 2 and np.size(vertices) and (np.abs(vertices) < 1e30).all()
        return prepare(_moved(vertices) if sound else vertices, faces, **named)

    def shape(make):
        def made(*given, **named):
            mesh = make(*given, **named)
            return trimesh.Trimesh(_moved(mesh.vertices), mesh.faces, process=False)

        return made

    meshes.prepare_mesh = prepared
    for name in ("box", "capsule", "cylinder", "icosphere", "torus"):
        setattr(trimesh.creation, name, shape(getattr(trimesh.creation, name)))


if SEED:
    _move_vertices()


def find_data(name):
    """A folder of real data; the test is skipped where it is absent, or would take hours without
    compiler.
    """
    if os.environ.get("NUMBA_DISABLE_JIT"):
        pytest.skip("real data takes hours without compiler")
    for place in (os.environ.get("RBFMUSCLE_DATA"), ROOT.parent / "shared" / "data"):
        if place and (Path(place) / name).is_dir():
            return Path(place) / name
    return pytest.skip(f"{name}/ is not here (set RBFMUSCLE_DATA to the folder that holds it)")


def samples(count):
    """So many points of a test, a twentieth without compiler, where each takes 1000 times as
    long.
    """
    return count // 20 if os.environ.get("NUMBA_DISABLE_JIT") else count


@pytest.fixture(scope="session")
def hip_data():
    """Folder of the real hip."""
    return find_data("hip")


@pytest.fixture(scope="session")
def hip_scene(hip_data):
    """The flexion scene of the real hip, loaded once; copy before changing it."""
    from rbfmuscle.scene.scene import Scene

    return Scene.load(hip_data / "flexion.toml")


@pytest.fixture(scope="session")
def leg_data():
    """Folder of the whole leg."""
    return find_data("leg")


@pytest.fixture(scope="session")
def arm_run(tmp_path_factory):
    """A run of the blended arm, seven frames to 60 degrees in mm, and its folder; copy before
    changing it.
    """
    from blend_model import arm_scene, use_blend_model

    from rbfmuscle.recording import simulate

    folder = tmp_path_factory.mktemp("arm")
    with pytest.MonkeyPatch.context() as patch:
        use_blend_model(patch)
        made = simulate(arm_scene(end=60))
    made.save(folder)
    return made, folder


@pytest.fixture
def clock(monkeypatch):
    """Each reading of the time is a 64th of a second after the one before, so that what is timed is
    the same anew.
    """
    ticks = itertools.count()
    for name in ("time.perf_counter", "time.process_time", "rbfmuscle.cli.check.perf_counter"):
        monkeypatch.setattr(name, lambda: next(ticks) / 64.0)


@pytest.fixture(scope="session")
def graphics():
    """Skip where VTK cannot draw; asked in a process of its own, which it may end."""
    code = (
        "import pyvista as p; q = p.Plotter(off_screen=True); q.add_mesh(p.Cube()); "
        "q.screenshot(None)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, timeout=120, check=False
    )
    if done.returncode != 0:
        pytest.skip("no graphics here")


def pytest_terminal_summary(terminalreporter):
    """Why tests were skipped, in one line."""
    reasons = [str(report.longrepr[-1]) for report in terminalreporter.stats.get("skipped", [])]
    if reasons:
        data = sum("RBFMUSCLE_DATA" in reason for reason in reasons)
        missing = sorted(
            {m[1] for reason in reasons if (m := re.search(r"could not import '(\w+)", reason))}
        )
        folder = "RBFMUSCLE_DATA names the folder that holds hip/, leg/ and osim/"
        parts = [f"{data} need data ({folder})"] if data else []
        parts += [f"packages not installed: {', '.join(missing)}"] if missing else []
        terminalreporter.write_line(
            f"{len(reasons)} skipped: {'; '.join([*parts, 'pytest -rs lists all'])}"
        )
