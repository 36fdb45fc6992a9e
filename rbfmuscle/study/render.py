"""Pictures and animations of a saved run, drawn in a process of their own.

VTK may end the process where no graphics exist. So everything is saved first, then this module is run as
``python -m rbfmuscle.study.render DIR`` with the job on its standard input.
"""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np

from rbfmuscle.study.appearance import BACKGROUND, BONE_COLOUR, muscle_colours
from rbfmuscle.study.saved import SavedRun
from rbfmuscle.validation import MissingPartError, RBFMuscleError, UsageError

# Where the camera stands; z is up, as in the medical axes (left, posterior, superior).
VIEWS = {
    "front": ((0.0, -1.0, 0.12), "from -y"),
    "side": ((-1.0, -0.12, 0.12), "from -x"),
    "back": ((0.0, 1.0, 0.12), "from +y"),
}
ANIMATIONS = (".webp", ".gif")
_STRIP = 30
_BONE_TRIANGLES = 12_000
_TIMEOUT = 1800


def render_run(directory, output, *, frame=None, views=None, size=(420, 520), seconds=5.0):
    """Draw a saved run to a picture or an animation.

    Parameters
    ----------
    directory : path
        Folder of the run.
    output : path
        ``.png`` for one frame, ``.gif`` or ``.webp`` for all.
    frame : int, optional
        Of a picture; the last one where not given.
    views : list of str, optional
        Of `VIEWS`, side by side; all where not given.
    size : (width, height)
        Of one view [pixel].
    seconds : float
        Length of an animation.

    Raises
    ------
    UsageError
        If the folder holds nothing to draw, or the suffix, frame or view is unknown.
    MissingPartError
        If there are no graphics to draw with.
    """
    saved, output = SavedRun(directory), Path(output)
    views = list(views or VIEWS)
    for view in views:
        if view not in VIEWS:
            raise UsageError(f"unknown view {view!r}; known: {', '.join(VIEWS)}")
    if output.suffix not in (".png", *ANIMATIONS):
        raise UsageError(f"{output}: the suffix must be .png, .gif or .webp")
    if not saved.has_surfaces():
        raise UsageError(f"{directory} has no surfaces to draw")
    frame = saved.frames[-1] if frame is None else frame
    if frame not in saved.frames:
        raise UsageError(
            f"frame {frame} was not written; the run has {saved.frames[0]} to {saved.frames[-1]}"
        )
    frames = [frame] if output.suffix == ".png" else saved.frames
    draw(
        directory, [{"file": str(output.resolve()), "frames": frames, "views": views, "size": size}], seconds
    )


def draw(directory, jobs, seconds=5.0):
    """Draw pictures in a child process.

    Parameters
    ----------
    directory : path
    jobs : list of dict
        ``file``, ``frames``, ``views``, ``size``; several frames make an animation.
    seconds : float
        Length of an animation.

    Raises
    ------
    MissingPartError
        If the child cannot draw; the message holds its last words.
    """
    command = [sys.executable, "-m", "rbfmuscle.study.render", str(directory)]
    text = json.dumps({"jobs": jobs, "seconds": seconds})
    try:
        done = subprocess.run(
            command, input=text, capture_output=True, text=True, timeout=_TIMEOUT, check=False
        )
    except subprocess.TimeoutExpired:
        raise MissingPartError(f"drawing took longer than {_TIMEOUT} s and was stopped") from None
    if done.returncode != 0:
        words = [line.strip() for line in done.stderr.splitlines() if line.strip()]
        reason = words[-1][-160:] if words else f"the drawing process ended with code {done.returncode}"
        raise MissingPartError(
            f"no pictures: {reason}; drawing needs OpenGL (a display, or Mesa's libegl1 and libgl1)"
        )


class Stage:
    """An off-screen window with several views of a scene, each aimed at the muscles' whole path."""

    def __init__(self, saved, views, size):
        import pyvista

        self.saved, self.views = saved, views
        shape = (1, len(views))
        window = (size[0] * len(views), size[1])
        self.plotter = pyvista.Plotter(off_screen=True, shape=shape, border=False, window_size=window)
        self.plotter.set_background(BACKGROUND)
        self.colours = muscle_colours(saved.muscles)
        bounds = _path_bounds(saved)
        self.bones = []
        for name in saved.bones:
            mesh = pyvista.make_tri_mesh(*saved.bone(name))
            if mesh.n_cells > _BONE_TRIANGLES:  # software drawing pays for each of them in every frame
                mesh = mesh.decimate(1.0 - _BONE_TRIANGLES / mesh.n_cells)
            mesh = mesh.compute_normals(split_vertices=False, auto_orient_normals=False)
            self.bones.append((name, [self._add(k, mesh, BONE_COLOUR) for k in range(len(views))]))
        self.skins = []
        for k, view in enumerate(views):
            self.plotter.subplot(0, k)
            self._aim(VIEWS[view][0], bounds, size)
            self.plotter.enable_anti_aliasing("ssaa")

    def show(self, frame):
        """Put bones and muscles where they are in a frame, and return the picture (h, w, 3) uint8."""
        import pyvista

        for name, actors in self.bones:
            for actor in actors:
                actor.user_matrix = self.saved.poses[frame][name]
        for actor in self.skins:
            self.plotter.remove_actor(actor, render=False)
        self.skins = []
        for muscle in self.saved.muscles:
            mesh = pyvista.make_tri_mesh(*self.saved.surface(muscle, frame))
            mesh = mesh.compute_normals(split_vertices=False, auto_orient_normals=False)
            self.skins += [self._add(k, mesh, self.colours[muscle]) for k in range(len(self.views))]
        for renderer in self.plotter.renderers:
            renderer.ResetCameraClippingRange()
        self.plotter.render()  # a screenshot alone shows what was drawn last
        return self.plotter.screenshot(return_img=True)

    def close(self):
        self.plotter.close()

    def _add(self, column, mesh, colour):
        self.plotter.subplot(0, column)
        return self.plotter.add_mesh(
            mesh,
            color=colour,
            smooth_shading=True,
            specular=0.25,
            specular_power=18,
            ambient=0.12,
            render=False,
            reset_camera=False,
        )

    def _aim(self, direction, bounds, size):
        """Parallel projection that holds the box in this view."""
        centre = bounds.mean(axis=0)
        ahead = np.asarray(direction) / np.linalg.norm(direction)
        right = np.cross([0.0, 0.0, 1.0], ahead)
        right /= np.linalg.norm(right)
        up = np.cross(ahead, right)
        corners = (
            np.array([[x, y, z] for x in bounds[:, 0] for y in bounds[:, 1] for z in bounds[:, 2]]) - centre
        )
        tall = np.ptp(corners @ up) / 2
        wide = np.ptp(corners @ right) / 2 * size[1] / size[0]
        camera = self.plotter.camera
        camera.focal_point = centre
        camera.position = centre + ahead * 4.0 * np.linalg.norm(bounds[1] - bounds[0])
        camera.up = up
        camera.parallel_projection = True
        camera.parallel_scale = 1.04 * max(tall, wide)


def _path_bounds(saved):
    """Box around the muscles in the first, middle and last frame."""
    frames = sorted({saved.frames[0], saved.frames[len(saved.frames) // 2], saved.frames[-1]})
    points = [saved.surface(muscle, frame)[0] for frame in frames for muscle in saved.muscles]
    return np.array(
        [np.min([p.min(axis=0) for p in points], axis=0), np.max([p.max(axis=0) for p in points], axis=0)]
    )


def caption(saved, frame):
    """Frame number and joint angles, as text."""
    entry = next(entry for entry in saved.info["frames"] if entry["frame"] == frame)
    angles = [f"{name} {value:.4g}°" for name, value in entry["coordinates"].items()]
    return ", ".join([f"frame {frame}", *angles])


def labelled(image, text, names, views):
    """Image with the views' names above, and below a strip with the caption and the muscles' colours."""
    from PIL import Image, ImageDraw, ImageFont

    font = ImageFont.load_default(13)
    height, width = image.shape[:2]
    chips = list(muscle_colours(names).items())
    sheet = Image.new("RGB", (width, height + _STRIP), BACKGROUND)
    sheet.paste(Image.fromarray(image), (0, 0))
    pen = ImageDraw.Draw(sheet)
    for k, view in enumerate(views):
        pen.text((k * width // len(views) + 8, 6), f"{view} ({VIEWS[view][1]})", fill="#8a8a8a", font=font)
    x = 8
    pen.text((x, height + 7), text, fill="#333333", font=font)
    x += int(pen.textlength(text, font=font)) + 22
    for name, colour in chips:
        wide = int(pen.textlength(name, font=font))
        if x + wide + 20 > width:
            break
        pen.rectangle((x, height + 9, x + 12, height + 21), fill=colour)
        pen.text((x + 17, height + 7), name, fill="#333333", font=font)
        x += wide + 36
    return sheet


def _draw_job(saved, job, seconds):
    from PIL import Image

    stage = Stage(saved, job["views"], job["size"])
    images = []
    for frame in job["frames"]:
        image = labelled(stage.show(frame), caption(saved, frame), saved.muscles, job["views"])
        if len(job["frames"]) == 1:
            image.save(job["file"])
        images.append(image)
    stage.close()
    if len(images) > 1:
        pause = max(20, int(1000 * seconds / len(images)))
        pauses = [pause] * (len(images) - 1) + [900]
        kind = {".webp": {"quality": 82, "method": 2}, ".gif": {"optimize": False}}[Path(job["file"]).suffix]
        if job["file"].endswith(".gif"):
            images = [image.quantize(128, dither=Image.Dither.NONE) for image in images]
        images[0].save(job["file"], save_all=True, append_images=images[1:], duration=pauses, loop=0, **kind)


def main(arguments):
    """The child's part: read the job, draw, leave with 0."""
    task = json.loads(sys.stdin.read())
    try:
        saved = SavedRun(arguments[0])
        for job in task["jobs"]:
            _draw_job(saved, job, task["seconds"])
    except (RBFMuscleError, OSError) as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
