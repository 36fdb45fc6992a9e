"""# Fibres and moment arms

A muscle's length is that of its centreline; its moment arm about a coordinate is minus the change of length with
the angle. A straight line from origin to insertion has both in closed form, and shows what wrapping changes.
"""

import numpy as np
from pictures import folder, plot

import rbfmuscle as rm
from rbfmuscle.sim.motion import bone_poses

out = folder("fibres_and_moment_arms")
scene = rm.phantom_scene(step=10.0)
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
    arms[muscle.name] = (arm, straight)
    middle = len(angles) // 2
    print(f"{muscle.name:20}{length[0]:10.1f}{length[-1]:10.1f}{arm[middle]:9.1f}{straight[middle]:10.1f}")


def lines(axes):
    for (name, (arm, straight)), colour in zip(arms.items(), ("#b5443f", "#2f6f8f", "#d99a2b", "#4f8a5b")):
        axes.plot(np.degrees(angles), arm, color=colour, label=name)
        axes.plot(np.degrees(angles), straight, ":", color=colour)
    axes.set(xlabel="flexion [degree]", ylabel="moment arm [mm]", title="dotted: straight line")
    axes.legend(fontsize=8)


plot(out / "arms.png", lines)

# Arms are derivatives of lengths: their integral is the change of length.
arm, length = arms["extensor"][0], run["extensor"].values("length")
change = -np.sum(0.5 * (arm[1:] + arm[:-1]) * np.diff(angles))
print(f"extensor: length changes by {length[-1] - length[0]:.2f} mm, the arms' integral is {change:.2f} mm")

# The check of this page: the integral agrees, and the extensor lengthens in flexion (a negative arm).
assert abs(change - (length[-1] - length[0])) < 0.02 * abs(length[-1] - length[0])
assert np.mean(arm) < 0
