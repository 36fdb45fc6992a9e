"""``rbfmuscle kernels --error``: the fewest centres that reach a wanted error, of a mesh or of each muscle."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from rbfmuscle.commands.scenes import is_mesh, load_scene
from rbfmuscle.compiled.progress import Progress
from rbfmuscle.validation import UsageError


def find_wanted(
    source: str,
    output: Path,
    errors: tuple[float | None, float | None],
    *,
    muscle: str | None,
    units: str,
    as_json: bool,
    **settings: Any,
) -> int:
    """Find, print and write what reaches an error.

    Parameters
    ----------
    source : str
        A mesh, a scene file, or ``phantom``.
    output : path
    errors : pair of float or None
        Exactly one: root mean square or greatest distance [mesh unit].
    muscle : str, optional
        Of a scene; all by default.
    units : str
        Of a mesh.
    as_json : bool
    **settings
        ``kernels``, ``placement`` and ``most`` of `reach_error`; None stands for its default.

    Returns
    -------
    int
        0; also where an error is not reached, which is said.
    """
    from rbfmuscle.study.experiment.wanted_error import reach_error
    from rbfmuscle.study.experiment.wanted_files import describe_wanted, write_wanted
    from rbfmuscle.study.files.writer import check_writable

    error, error_max = errors
    if (error is None) == (error_max is None):
        raise UsageError("give one of --error (RMS) and --error-max (greatest distance)")
    wanted = error if error is not None else error_max
    if wanted is None or not wanted > 0.0:
        raise UsageError(f"the wanted error must be a positive length, got {wanted}")
    settings = {name: value for name, value in settings.items() if value is not None}
    meshes, unit = _meshes(source, muscle, units)
    check_writable(output)
    results = {}
    for name, mesh in meshes.items():
        with Progress(f"kernels of {name}", what="fit") as bar:
            results[name] = reach_error(mesh, wanted, greatest=error is None, progress=bar, **settings)
    try:
        write_wanted(results, output, units=unit)
    except OSError as failed:
        raise UsageError(f"cannot write to {output}: {failed.strerror}; choose another --output") from None
    if as_json:
        print((output / "error.json").read_text(encoding="utf-8"))
        return 0
    for name, found in results.items():
        print(describe_wanted(name, found, unit))
    print(f"all that was tried in {output / 'error.json'}")
    for name, found in results.items():
        if found.reached:
            print(f"\nto paste at the end of the [[muscle]] {json.dumps(name)}:\n\n{found.toml()}")
    return 0


def _meshes(source, muscle, units):
    """Meshes by name, and their unit."""
    from rbfmuscle.sim.scene.meshes import read_mesh

    if is_mesh(source):
        return {Path(source).stem: read_mesh(source).mesh}, units
    scene = load_scene(source)
    chosen = [scene.muscle(muscle)] if muscle else scene.muscles
    return {each.name: each.mesh for each in chosen}, scene.units
