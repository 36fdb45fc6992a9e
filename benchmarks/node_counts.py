"""What the number of nodes of the solid changes on the phantom: its vertices and its bowing.

``python benchmarks/node_counts.py``: the demo's motion with 150, 300, 600 and 1,200 nodes, without
surfaces. For each number but the last, and each muscle, the RMS distance of its vertices from those
on a lattice with twice the nodes, greatest over the frames [mm]; and the greatest bowing, beside
its limit.
"""

import argparse

import numpy as np
from evidence import write_evidence

from rbfmuscle.metrics.centreline import Centreline, moving_joints
from rbfmuscle.metrics.summary import LIMITS, MORE_BOWING
from rbfmuscle.models import build_models, configure_scene
from rbfmuscle.scene.motion import bone_poses
from rbfmuscle.scene.phantom import phantom_scene
from rbfmuscle.simulation.frame_loop import simulate_frames

NODES = (150, 300, 600, 1200)
COLUMNS = ["nodes", "muscle", "from twice the nodes", "bowing", "limit"]


class Motion:
    """Vertices of each muscle in each frame (f, n, 3), with so many nodes, and its bowing."""

    def __init__(self, nodes):
        scene = configure_scene(phantom_scene(), {"model.nodes": nodes})
        models = build_models(scene)
        probes = [bone.exact for bone in scene.bones]
        meshes = {model.name: model.material_mesh() for model in models}
        lines = {
            muscle.name: Centreline(
                muscle, scene.joints, *meshes[muscle.name], moving=moving_joints(scene)
            )
            for muscle in scene.muscles
        }
        rest = bone_poses(scene, {})
        self.vertices = {name: [] for name in lines}
        self.bowing = dict.fromkeys(lines, 0.0)
        self.limit = {
            name: max(
                LIMITS["bowing"].value,
                line.measure(meshes[name][0], rest, probes)[1] + MORE_BOWING,
            )
            for name, line in lines.items()
        }
        for frame in simulate_frames(scene, models, surfaces=False):
            for name, line in lines.items():
                vertices = frame.material_meshes[name][0]
                self.vertices[name].append(vertices)
                bowing = line.measure(vertices, frame.poses, probes)[1]
                self.bowing[name] = max(self.bowing[name], bowing)


def apart(one, other):
    """RMS distance of vertices (f, n, 3), the greatest over the frames."""
    square = np.sum((np.array(one) - np.array(other)) ** 2, axis=2)
    return float(np.sqrt(square.mean(axis=1)).max())


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("-o", "--output", help="file of evidence for the pages")
    options = parser.parse_args()
    motions = {nodes: Motion(nodes) for nodes in NODES}
    rows = []
    for nodes in NODES[:-1]:
        coarse, fine = motions[nodes], motions[2 * nodes]
        for name in coarse.vertices:
            away = apart(coarse.vertices[name], fine.vertices[name])
            numbers = (round(x, 3) for x in (coarse.bowing[name], coarse.limit[name]))
            rows.append([nodes, name.replace("_", " "), round(away, 2), *map(str, numbers)])
    for row in rows:
        print(*row, sep="\t")
    if options.output:
        write_evidence(options.output, ["benchmarks/node_counts.py"], rows, COLUMNS)


if __name__ == "__main__":
    main()
