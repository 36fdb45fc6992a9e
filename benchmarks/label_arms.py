"""Moment arms of muscles from a label volume against those of the meshes it was made of.

    python benchmarks/label_arms.py --source hip --voxel 1.0

The meshes (the embedded phantom, or ``data/hip``) become labels of so many millimetres; meshes and labels then go the
same way, through `rbfmuscle new` and a run of hip flexion about one centre and axis, and moment arms are taken by
nudging at each frame. Guessed attachments differ as the surfaces do: that is part of what is measured.
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


def arms(folder: Path, words: list[str], centre: np.ndarray, axis: np.ndarray) -> dict[str, np.ndarray]:
    """Moment arms (frames,) by muscle of what `new` makes of a source, flexed about the given axis."""
    from rbfmuscle.app import run_command

    file = folder / "scene.toml"
    if run_command(["new", *words, "-o", str(file)]):
        raise SystemExit("new did not end well")
    scene = rm.Scene.load(file)
    moving = next(joint for joint in scene.joints if joint.child == "femur")
    scene.joints = [joint for joint in scene.joints if joint is not moving]
    scene.add_joint("hip", moving.parent, "femur", centre, {"flexion": axis})
    scene.set_motion(ramp={"hip.flexion": {"from": 0.0, "to": END, "step": STEP}})
    run = rm.simulate(scene, settings={"output.moment_arms": True})
    return {
        muscle.name: np.array(
            [r.value for r in run.metrics if r.muscle == muscle.name and r.quantity == "moment_arm"]
        )
        for muscle in run
    }


def main() -> int:
    """Both ways, and how far apart they are."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--source", choices=("phantom", "hip"), default="phantom")
    parser.add_argument("--voxel", type=float, default=1.0)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    asked = parser.parse_args()
    meshes, centre, axis = source_meshes(asked.source, asked.data)
    with tempfile.TemporaryDirectory() as home:
        import nibabel

        plain, labelled = Path(home) / "plain", Path(home) / "labelled"
        plain.mkdir()
        for name, mesh in meshes.items():
            mesh.export(plain / f"{name}.ply")
        labels, affine = voxelise(meshes, asked.voxel)
        image = nibabel.Nifti1Image(labels, affine)
        image.header.set_xyzt_units("mm")
        nibabel.save(image, Path(home) / "labels.nii.gz")
        names = {str(number): name for number, name in enumerate(meshes, start=1)}
        (Path(home) / "names.json").write_text(json.dumps(names), encoding="utf-8")
        true = arms(plain, [str(plain), "--units", "mm"], centre, axis)
        words = [str(Path(home) / "labels.nii.gz"), "--labels", str(Path(home) / "names.json")]
        found = arms(labelled, words, centre, axis)
    differences = []
    for name, values in true.items():
        off = found[name] - values
        differences.append(off)
        rms = np.sqrt(np.mean(off**2))
        print(
            f"{name:22} arms {values.min():7.2f} to {values.max():7.2f} mm; labels differ by {rms:.2f} RMS, "
            f"{np.abs(off).max():.2f} at most"
        )
    print(f"all: {np.sqrt(np.mean(np.concatenate(differences) ** 2)):.2f} mm RMS")
    return 0


if __name__ == "__main__":
    sys.exit(main())
