"""Names that not every system has: all modules are imported and all formats read without them."""

import json
import os
import subprocess
import sys

import pytest
from conftest import ROOT

# Read by every process at its start. What Windows lacks, as far as the standard library lives
# without it here; select takes sockets alone there.
WITHOUT = """
import os, select, signal, sys
for module, names in (
    (os, "set_blocking get_blocking fork forkpty setsid killpg getpgid sched_getaffinity mkfifo"),
    (signal, "pause alarm setitimer sigwait SIGALRM SIGKILL SIGHUP SIGUSR1 SIGQUIT SIGSTOP"),
):
    for name in names.split():
        if hasattr(module, name):
            delattr(module, name)
for name in "resource fcntl termios pwd grp tty pty syslog".split():
    sys.modules[name] = None
def refuse(*given):
    raise OSError(10038, "an operation on something that is not a socket")
select.select = refuse
"""


@pytest.fixture
def elsewhere(tmp_path):
    """Environment of processes that lack the names."""
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(WITHOUT)
    path = os.pathsep.join([str(tmp_path / "site"), str(ROOT)])
    return {**os.environ, "PYTHONPATH": path}


def run(code, environment, **options):
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, **options
    )
    return done.returncode, done.stdout, done.stderr


def test_every_module_is_imported_and_each_format_of_meshes_read(elsewhere, tmp_path):
    code = """
import importlib, os, pkgutil, sys
assert sys.modules["resource"] is None and not hasattr(os, "set_blocking")
import pbd_baseline, rbfmuscle
names = [m.name for p in (rbfmuscle, pbd_baseline)
         for m in pkgutil.walk_packages(p.__path__, p.__name__ + ".")]
for name in names:
    if not name.endswith("__main__"):
        importlib.import_module(name)
print(len(names))
import pyvista, trimesh
from rbfmuscle.scene.meshes.read import MESH_SUFFIXES, read_mesh
ball = trimesh.creation.icosphere(subdivisions=2, radius=20.0)
for suffix in MESH_SUFFIXES:
    file = f"ball{suffix}"
    pyvista.wrap(ball).save(file) if suffix[:3] == ".vt" else ball.export(file)
    assert abs(read_mesh(file).mesh.volume / ball.volume - 1.0) < 1e-6
    print(suffix)
"""
    code, out, err = run(code, elsewhere, cwd=tmp_path)
    assert code == 0, err
    modules, *suffixes = out.split()
    assert int(modules) > 150 and len(suffixes) >= 5


def test_command_line_starts_and_ends_at_an_interrupt_of_which_json_tells(elsewhere, tmp_path):
    code = """
import os, signal, sys, rbfmuscle.cli as cli
import rbfmuscle.scene.file as file
file.read_scene_file = lambda path: os.kill(os.getpid(), signal.SIGINT)
sys.argv = ["rbfmuscle", "check", "a.toml", "--json"]
cli.main()
"""
    code, out, err = run(code, elsewhere, cwd=tmp_path)
    assert (code, err) == (130, "rbfmuscle: interrupted\n")
    assert json.loads(out) == {"error": "interrupted", "exit_code": 130}
