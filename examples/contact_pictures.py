"""Pictures of the contact page: tunnelled and corrected, overlapping and resolved, passing through
each other and touching.

    python examples/contact_pictures.py docs/images

Not a page of the gallery.
"""

import math

import igl
import numpy as np
import pyvista
import trimesh
from pictures import folder
from PIL import Image

import rbfmuscle as rm
from rbfmuscle.models import build_model
from rbfmuscle.scene.motion import bone_poses
from rbfmuscle.scene.options import DetectOptions, NeighbourOptions, TunnellingOptions
from rbfmuscle.simulation.contact import BoneContacts, BonesInReach
from rbfmuscle.simulation.group import Group
from rbfmuscle.simulation.stepper import MuscleStepper, Path

out = folder("contact_pictures")
pyvista.OFF_SCREEN = True


def picture(name, panels, *, view, zoom=1.0):
    """Side by side: each panel a title and meshes as (vertices, faces, colour, opacity)."""
    plotter = pyvista.Plotter(
        shape=(1, len(panels)), border=False, window_size=(460 * len(panels), 460), off_screen=True
    )
    for k, (title, meshes) in enumerate(panels):
        plotter.subplot(0, k)
        plotter.set_background("white")
        for vertices, faces, colour, opacity in meshes:
            plotter.add_mesh(
                pyvista.make_tri_mesh(vertices, faces),
                color=colour,
                opacity=opacity,
                smooth_shading=True,
            )
        plotter.add_text(title, font_size=9, color="black")
        focus = meshes[0][0].mean(axis=0)
        plotter.camera.position = tuple(focus + np.array(view) * 520.0 / zoom)
        plotter.camera.focal_point, plotter.camera.up = tuple(focus), (0.0, 0.0, 1.0)
    image = plotter.screenshot(return_img=True)
    plotter.close()
    Image.fromarray(image).save(out / f"contact_{name}.webp", quality=80)


def slices(name, panels, *, height):
    """Side by side: each panel a title and meshes as (vertices, faces, colour, ...), cut at a
    height.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.6 * len(panels), 4.2), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    for axes, (title, meshes) in zip(
        figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True
    ):
        for vertices, faces, colour, *_ in meshes:
            cut = trimesh.Trimesh(vertices, faces, process=False).section(
                [0.0, 0.0, 1.0], [0.0, 0.0, height]
            )
            for line in [] if cut is None else cut.discrete:
                axes.fill(line[:, 0], line[:, 1], color=colour, alpha=0.45, lw=0)
                axes.plot(line[:, 0], line[:, 1], color=colour, lw=1.3)
        low, high = meshes[0][0].min(axis=0), meshes[0][0].max(axis=0)
        axes.set(
            title=title,
            aspect="equal",
            xlabel="x [mm]",
            ylabel="y [mm]",
            xlim=(low[0] - 15, high[0] + 15),
            ylim=(low[1] - 15, high[1] + 15),
        )
    canvas.draw()
    Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3]).save(
        out / f"contact_{name}.webp", quality=85
    )


def bones(scene, coordinates):
    poses = bone_poses(scene, coordinates)
    moved = ((bone, poses[bone.name]) for bone in scene.bones)
    return [
        (bone.mesh.vertices @ pose[:3, :3].T + pose[:3, 3], bone.mesh.faces, "#b8a77f", 1.0)
        for bone, pose in moved
    ]


def depth(vertices, meshes):
    """Deepest of the vertices in any of the meshes."""
    found = [
        -igl.signed_distance(
            np.ascontiguousarray(vertices),
            np.ascontiguousarray(v),
            np.ascontiguousarray(f),
            sign_type=igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER,
        )[0].min()
        for v, f, *_ in meshes
    ]
    return max(0.0, *map(float, found))


# Tunnelled and corrected: one step of 40 degrees, as a slow machine might take it.
scene = rm.phantom_scene()
muscle = scene.muscle("adductor_posterior")
fields = [rm.BoneSDF.from_mesh(bone.mesh) for bone in scene.bones]
rest, turned = {"hip.adduction": 0.0}, {"hip.adduction": math.radians(40.0)}
panels, remaining = [], {}
for action, title in (("report", "tunnelled"), ("substep", "corrected")):
    scene.detect = DetectOptions(tunnelling=TunnellingOptions(action=action))
    model = build_model(muscle, scene, "pbd")
    names = [bone.name for bone in scene.bones]
    stepper = MuscleStepper(
        model, BoneContacts(BonesInReach(names, fields), model.attached_bone), scene
    )
    Group([stepper]).step(Path.between(rest, turned, stepper.poses))
    remaining[action] = {event.action for event in stepper.collect()[1]}
    panels.append((title, [(*model.material_mesh(), "#a63d38", 0.75), *bones(scene, turned)]))
picture("tunnelling", panels, view=(0.55, -0.8, 0.1), zoom=1.3)

# Unfelt and touching: two neighbours in extension.
panels, overlap = [], {}
pair = ("adductor_anterior", "adductor_posterior")
for neighbours, title in ((None, "neighbours = false"), (NeighbourOptions(), "neighbours")):
    scene = rm.phantom_scene()
    scene.muscles = [scene.muscle(name) for name in pair]
    scene.neighbours = neighbours
    scene.set_motion(ramp={"hip.flexion": {"from": 0, "to": -20, "step": 2}})
    run = rm.simulate(scene, model="rbf")
    one, two = (run[name].surface() for name in pair)
    overlap[title] = depth(one.vertices, [(two.vertices, two.faces)])
    text = f"{title}: {overlap[title]:.1f} mm into each other"
    meshes = [(one.vertices, one.faces, "#7a2340", 1.0), (two.vertices, two.faces, "#c4698f", 0.7)]
    panels.append((text, [*meshes, *bones(scene, {"hip.flexion": math.radians(-20.0)})]))
slices("neighbours", panels, height=float(one.vertices[:, 2].mean()))

print(remaining, overlap)
assert all(isinstance(mesh, trimesh.Trimesh) and mesh.is_watertight for mesh in (one, two))
assert "reported" in remaining["report"] and "unresolved" not in remaining["substep"]
assert overlap["neighbours = false"] > 1.0 and overlap["neighbours"] < 0.5
