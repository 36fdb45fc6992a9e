"""Moment arms of muscles from a label volume against those of the meshes it was made of.

    python benchmarks/label_arms.py --source hip --voxel 1.0 [--ways guessed,carried,subdivided] [--keep DIR]

The meshes (the embedded phantom, or ``data/hip``) become labels of so many millimetres; meshes and labels then go the
same way, through `rbfmuscle new` and a run of hip flexion about one centre and axis, and moment arms are taken by
nudging at each frame. Causes are told apart by ``--ways``: ``guessed`` patches for each scene; ``carried``, the patches
of the meshes on the label surfaces; ``subdivided``, the same meshes and patches with other vertices: what is left then
is the muscle's own.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path

import numpy as np
import trimesh

import rbfmuscle as rm

END, STEP = 60.0, 10.0


def voxelise(meshes: dict[str, trimesh.Trimesh], voxel: float) -> tuple[np.ndarray, np.ndarray]:
    """Labels (x, y, z), numbered from 1 in the order of the meshes, and the affine of their file."""
    low = np.min([mesh.bounds[0] for mesh in meshes.values()], axis=0) - 4 * voxel
    high = np.max([mesh.bounds[1] for mesh in meshes.values()], axis=0) + 4 * voxel
    shape = np.ceil((high - low) / voxel).astype(int) + 1
    labels = np.zeros(shape, dtype=np.uint8)
    for number, mesh in enumerate(meshes.values(), start=1):
        field = rm.BoneSDF.from_mesh(mesh)
        first = np.floor((mesh.bounds[0] - low) / voxel).astype(int)
        last = np.ceil((mesh.bounds[1] - low) / voxel).astype(int) + 1
        part = labels[tuple(slice(a, b) for a, b in zip(first, last))]
        grid = np.stack(np.meshgrid(*(np.arange(a, b) for a, b in zip(first, last)), indexing="ij"), axis=-1)
        inside = field.distance(low + voxel * grid.reshape(-1, 3)).reshape(part.shape) < 0.0
        part[inside & (part == 0)] = number
    return labels, np.block([[voxel * np.eye(3), low[:, None]], [np.zeros((1, 3)), 1.0]])


def source_meshes(name: str, data: Path) -> tuple[dict[str, trimesh.Trimesh], np.ndarray, np.ndarray]:
    """Meshes by name, bones first, and centre and axis of flexion."""
    if name == "phantom":
        scene = rm.phantom_scene()
    else:
        scene = rm.Scene.load(data / "hip" / "flexion.toml")
    joint = scene.joints[0]
    axis = joint.frame[:3, :3] @ np.asarray(joint.rotations[0].direction, dtype=float)
    return {item.name: item.mesh for item in scene.bones + scene.muscles}, np.asarray(joint.centre), axis


def guessed(words: list[str], file: Path, centre: np.ndarray, axis: np.ndarray) -> rm.Scene:
    """What `new` makes of a source, to be flexed about the given axis."""
    from rbfmuscle.app import run_command

    if not file.exists() and run_command(["new", *words, "-o", str(file)]):
        raise SystemExit("new did not end well")
    scene = rm.Scene.load(file)
    moving = next(joint for joint in scene.joints if joint.child == "femur")
    scene.joints = [joint for joint in scene.joints if joint is not moving]
    scene.add_joint("hip", moving.parent, "femur", centre, {"flexion": axis})
    scene.set_motion(ramp={"hip.flexion": {"from": 0.0, "to": END, "step": STEP}})
    return scene


def carried(scene: rm.Scene, patches: rm.Scene, options: dict | None = None) -> rm.Scene:
    """A scene with the patches of another one: a vertex is held where the nearest place of the other surface is."""
    muscles, scene = scene.muscles, scene.with_options({}, model=None)
    scene.muscles = []
    for muscle in muscles:
        other = next(one for one in patches.muscles if one.name == muscle.name)
        near, _, face = trimesh.proximity.closest_point(other.mesh, muscle.mesh.vertices)
        weights = np.clip(trimesh.triangles.points_to_barycentric(other.mesh.triangles[face], near), 0.0, 1.0)
        shares = np.array(
            [(weights * np.isin(other.mesh.faces[face], h.vertices)).sum(axis=1) for h in other.attachments]
        )
        held = np.where(shares.max(axis=0) > 0.5, shares.argmax(axis=0), -1)
        attach = [
            {"bone": hold.bone, "vertices": np.flatnonzero(held == k)}
            for k, hold in enumerate(other.attachments)
        ]
        scene.add_muscle(
            muscle.name,
            (muscle.mesh.vertices, muscle.mesh.faces),
            attach=attach,
            model={"name": "rbf", **(options or {})},
        )
    return scene


def subdivided(scene: rm.Scene) -> rm.Scene:
    """The same surfaces and patches with four triangles for each: what arms owe to vertices alone."""
    fine, scene = [], scene.with_options({}, model=None)
    for muscle in scene.muscles:
        fine.append(
            (muscle.name, trimesh.remesh.subdivide(muscle.mesh.vertices, muscle.mesh.faces), muscle.mesh)
        )
    result = scene.with_options({}, model=None)
    result.muscles = []
    for name, mesh, _ in fine:
        result.add_muscle(name, mesh, model="rbf")
    return carried(result, scene)


def arms(scene: rm.Scene, settings: dict) -> dict[str, np.ndarray]:
    """Moment arms (frames,) by muscle."""
    run = rm.simulate(scene, settings={"output.moment_arms": True, **settings})
    return {
        muscle.name: np.array(
            [r.value for r in run.metrics if r.muscle == muscle.name and r.quantity == "moment_arm"]
        )
        for muscle in run
    }


def patch_text(first: rm.Scene, second: rm.Scene) -> None:
    """How far the guessed patches of two scenes are apart."""
    for muscle in first.muscles:
        other = next(one for one in second.muscles if one.name == muscle.name)
        for hold in muscle.attachments:
            same = [one for one in other.attachments if one.bone == hold.bone]
            if not same:
                print(f"{muscle.name:18} {hold.bone:8} not held in the other scene")
                continue
            areas, middles = zip(
                *(patch_size(m.mesh, h.vertices) for m, h in ((muscle, hold), (other, same[0])))
            )
            print(
                f"{muscle.name:18} {hold.bone:8} {areas[0]:7.0f} and {areas[1]:7.0f} mm2, "
                f"middles {np.linalg.norm(middles[0] - middles[1]):.1f} mm apart"
            )


def patch_size(mesh: trimesh.Trimesh, vertices: np.ndarray) -> tuple[float, np.ndarray]:
    """Area of a patch, a third of each triangle for each of its corners, and the middle of the area."""
    held = np.isin(mesh.faces, vertices).sum(axis=1) / 3.0 * mesh.area_faces
    return float(held.sum()), (held[:, None] * mesh.triangles_center).sum(axis=0) / held.sum()


def tell(title: str, true: dict[str, np.ndarray], found: dict[str, np.ndarray]) -> None:
    """Differences of arms, by muscle."""
    print(title)
    for name, values in true.items():
        off = found[name] - values
        rms = np.sqrt(np.mean(off**2))
        print(
            f"  {name:18} arms {values.min():7.2f} to {values.max():7.2f} mm; differ by {rms:.2f} RMS, "
            f"{np.abs(off).max():.2f} at most: {' '.join(f'{x:.1f}' for x in off)}"
        )
    differences = np.concatenate([found[name] - true[name] for name in true])
    print(f"  all: {np.sqrt(np.mean(differences**2)):.2f} mm RMS", flush=True)


def write_sources(home: Path, meshes: dict[str, trimesh.Trimesh], voxel: float) -> None:
    """The meshes in ``plain``, their labels and names beside it."""
    import nibabel

    if (home / "plain").exists():
        return
    (home / "plain").mkdir(parents=True)
    (home / "labelled").mkdir()
    for name, mesh in meshes.items():
        mesh.export(home / "plain" / f"{name}.ply")
    labels, affine = voxelise(meshes, voxel)
    image = nibabel.Nifti1Image(labels, affine)
    image.header.set_xyzt_units("mm")
    nibabel.save(image, home / "labels.nii.gz")
    names = {str(number): name for number, name in enumerate(meshes, start=1)}
    (home / "names.json").write_text(json.dumps(names), encoding="utf-8")


def main() -> int:
    """Both ways, and how far apart they are."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--source", choices=("phantom", "hip"), default="phantom")
    parser.add_argument("--voxel", type=float, default=1.0)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument(
        "--keep", type=Path, help="folder for the sources and scenes, taken where they are there"
    )
    parser.add_argument("--ways", default="guessed,carried,subdivided")
    parser.add_argument(
        "--set", action="append", default=[], help="KEY=VALUE of all runs, as model.inside=300"
    )
    asked = parser.parse_args()
    meshes, centre, axis = source_meshes(asked.source, asked.data)
    settings = {key: json.loads(value) for key, value in (one.split("=", 1) for one in asked.set)}
    with tempfile.TemporaryDirectory() as folder:
        home = asked.keep or Path(folder)
        write_sources(home, meshes, asked.voxel)
        plain = guessed([str(home / "plain"), "--units", "mm"], home / "plain" / "scene.toml", centre, axis)
        words = [str(home / "labels.nii.gz"), "--labels", str(home / "names.json")]
        labelled = guessed(words, home / "labelled" / "scene.toml", centre, axis)
        patch_text(plain, labelled)
        ways, true = asked.ways.split(","), arms(plain, settings)
        if "guessed" in ways:
            tell("labels, patches guessed for each", true, arms(labelled, settings))
        if "carried" in ways:
            tell("labels, patches of the meshes", true, arms(carried(labelled, plain), settings))
        if "subdivided" in ways:
            tell("the meshes, four triangles for each", true, arms(subdivided(plain), settings))
    return 0


if __name__ == "__main__":
    sys.exit(main())
