"""# Fibres and moment arms

A muscle's length is that of its centreline; its moment arm about a coordinate is minus the change of length with
the angle. Fibres are streamlines from origin to insertion, each with a length and an arm of its own. A straight
line from origin to insertion has both in closed form, and shows what wrapping changes.
"""

import numpy as np
from pictures import folder, plot

import rbfmuscle as rm
from rbfmuscle.sim.scene.motion import bone_poses

out = folder("fibres_and_moment_arms")
scene = rm.phantom_scene(step=10.0).with_options({"output.fibres": {"count": 60, "segments": 15}})
run = rm.simulate(scene)
angles = np.array([frame.coordinates["hip.flexion"] for frame in run.frames])


def straight_lengths(muscle):
    """Distance of the attachments' centroids, frame by frame [mm]."""
    ends = [(a.bone, np.asarray(muscle.mesh.vertices)[a.vertices].mean(axis=0)) for a in muscle.attachments]
    lengths = []
    for frame in run.frames:
        poses = bone_poses(scene, frame.coordinates)
        (a, b) = (poses[bone][:3, :3] @ point + poses[bone][:3, 3] for bone, point in ends)
        lengths.append(np.linalg.norm(a - b))
    return np.array(lengths)


arms = {}
print(f"{'muscle':20}{'length 0':>10}{'length 90':>10}{'arm 45':>9}{'straight':>10}   [mm, mm a radian]")
for muscle in scene.muscles:
    length, arm = run[muscle.name].values("length"), run[muscle.name].values("moment_arm")
    straight = -np.gradient(straight_lengths(muscle), angles)
    spread = [run[muscle.name].values(f"fibre_moment_arm_{kind}") for kind in ("mean", "std")]
    arms[muscle.name] = (arm, straight, *spread)
    middle = len(angles) // 2
    print(f"{muscle.name:20}{length[0]:10.1f}{length[-1]:10.1f}{arm[middle]:9.1f}{straight[middle]:10.1f}")


def lines(axes):
    colours = ("#b5443f", "#2f6f8f", "#d99a2b", "#4f8a5b")
    for (name, (arm, straight, mean, std)), colour in zip(arms.items(), colours):
        axes.plot(np.degrees(angles), arm, color=colour, label=name)
        axes.plot(np.degrees(angles), straight, ":", color=colour)
        axes.fill_between(np.degrees(angles), mean - std, mean + std, color=colour, alpha=0.2, lw=0)
    title = "dotted: straight line; band: fibres, mean and standard deviation"
    axes.set(xlabel="flexion [degree]", ylabel="moment arm [mm]", title=title)
    axes.legend(fontsize=8)


plot(out / "arms.png", lines)

# Arms are derivatives of lengths: their integral is the change of length.
arm, length = arms["extensor"][0], run["extensor"].values("length")
change = -np.sum(0.5 * (arm[1:] + arm[:-1]) * np.diff(angles))
print(f"extensor: length changes by {length[-1] - length[0]:.2f} mm, the arms' integral is {change:.2f} mm")

fibres = run["extensor"].fibres(frame=-1)
stretch = fibres.lengths / fibres.rest_lengths
print(f"extensor at 90 degrees: {len(stretch)} fibres, {fibres.lengths.mean():.1f} mm long in the mean, "
      f"stretched {stretch.min():.2f} to {stretch.max():.2f} times")  # fmt: skip


def bundle(axes):
    for name, colour in zip(arms, ("#b5443f", "#2f6f8f", "#d99a2b", "#4f8a5b")):
        for line in run[name].fibres(frame=-1).points:
            axes.plot(line[:, 1], line[:, 2], color=colour, lw=0.6)
    axes.set(xlabel="y [mm]", ylabel="z [mm]", title="fibres at 90 degrees, from the side", aspect="equal")


plot(out / "fibres.png", bundle, size=(5.0, 5.0))

# The check of this page: the integral agrees, and the extensor lengthens in flexion (a negative arm).
assert abs(change - (length[-1] - length[0])) < 0.02 * abs(length[-1] - length[0])
assert np.mean(arm) < 0
assert abs(fibres.lengths.mean() - length[-1]) < 0.1 * length[-1]
