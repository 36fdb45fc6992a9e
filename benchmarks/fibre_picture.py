"""The picture of docs/fibres.md: fibres of the embedded hip at rest and in 60 degrees of flexion, out of its bones.

python benchmarks/fibre_picture.py docs/images/fibres.webp
"""

import sys
from pathlib import Path

import numpy as np

from rbfmuscle.run import simulate
from rbfmuscle.sim.scene.phantom import phantom_scene
from rbfmuscle.study.show.appearance import BONE_COLOUR, line_colours

END, SIZE = 60.0, (460, 460)


def main(path):
    import pyvista
    from PIL import Image

    scene = phantom_scene(end=END)
    settings = {"output.fibres": True, "output.metrics": False}
    run = simulate(scene, settings=settings, frames=f"0:{len(scene.motion)}:{len(scene.motion) - 1}")
    colours = line_colours([muscle.name for muscle in scene.muscles])
    plotter = pyvista.Plotter(shape=(1, 2), border=False, window_size=(2 * SIZE[0], SIZE[1]), off_screen=True)
    for k, frame in enumerate((run.frames[0], run.frames[-1])):
        plotter.subplot(0, k)
        plotter.set_background("white")
        for bone in scene.bones:
            mesh = pyvista.make_tri_mesh(np.asarray(bone.mesh.vertices), np.asarray(bone.mesh.faces))
            mesh = mesh.transform(frame.poses[bone.name], inplace=False)
            plotter.add_mesh(mesh, color=BONE_COLOUR, opacity=0.45, smooth_shading=True)
        for muscle, colour in colours.items():
            points = frame.fibres[muscle].points[::2]
            count, length = points.shape[:2]
            rows = np.arange(count * length).reshape(count, length)
            cells = np.column_stack([np.full(count, length), rows]).ravel()
            plotter.add_mesh(
                pyvista.PolyData(points.reshape(-1, 3), lines=cells), color=colour, line_width=1.2
            )
        plotter.camera_position = [(-900.0, -350.0, 120.0), (0.0, 0.0, -60.0), (0.0, 0.0, 1.0)]
        plotter.reset_camera()
        plotter.camera.zoom(1.1)
    image = plotter.screenshot(return_img=True)
    plotter.close()
    Image.fromarray(image).save(Path(path), quality=80)


if __name__ == "__main__":
    main(sys.argv[1])
