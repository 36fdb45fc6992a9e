"""Surfaces of a kernel study by their errors, drawn in a child process: VTK may end it where no graphics exist."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfmuscle.study.experiment.kernel_choice import named
from rbfmuscle.validation import MissingPartError

if TYPE_CHECKING:
    from rbfmuscle.study.experiment.kernel_study import KernelStudy

# Surfaces whose difference to the recommended one is drawn.
DIFFERENCES = 4


def draw_surfaces(study: KernelStudy, directory: Path) -> bytes | None:
    """The recommended surface by its error and how others differ from it, as a PNG; None where none is recommended."""
    found = study.recommended
    if found is None:
        return None
    from rbfmuscle.study.measure.mesh_distance import MeshDistance

    pairs = list(zip(study.rows, study.surfaces, strict=True))
    vertices, faces, error = next(surface for row, surface in pairs if row is found.row)
    unit = study.units or "mesh units"
    arrays = {
        "most": np.array(float(np.quantile(np.abs(error), 0.995))), "unit": np.array(unit), "v": vertices, "f": faces,
        "worst": np.array([place["point"] for place in found.row["worst"]]).reshape(-1, 3), "e0": error,
        "t0": np.array(f"{named(found.row)}, recommended: {found.row['rms']:.2g} {unit} RMS"),
    }  # fmt: skip
    others = [found.quickest, found.most_accurate, *(row for row, _ in pairs if not row["unfit"])]
    others = list({id(row): row for row in others if row is not None and row is not found.row}.values())[
        :DIFFERENCES
    ]
    for k, other in enumerate(others, 1):
        surface = next(surface for row, surface in pairs if row is other)
        away = MeshDistance(surface[0], surface[1], closed=False).signed(vertices)
        arrays |= {f"e{k}": -away, f"t{k}": np.array(f"{named(other)}: {other['rms']:.2g} {unit} RMS")}
    np.savez(directory / "surfaces.npz", **arrays)
    picture = directory / "surfaces.png"
    module = "rbfmuscle.study.show.kernels.surfaces"
    command = [sys.executable, "-m", module, str(directory / "surfaces.npz"), str(picture)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    if done.returncode != 0 or not picture.exists():
        words = [line.strip() for line in done.stderr.splitlines() if line.strip()]
        reason = words[-1][-160:] if words else f"the drawing process ended with code {done.returncode}"
        raise MissingPartError(
            f"no pictures: {reason}; drawing needs OpenGL (a display, or Mesa's libegl1 and libgl1)"
        )
    return picture.read_bytes()


def main(source: Any, target: Any) -> None:
    """The child's part."""
    import pyvista

    with np.load(source) as arrays:
        count = sum(name.startswith("e") for name in arrays.files)
        middle = arrays["v"].mean(axis=0)
        axes = np.linalg.svd(arrays["v"] - middle, full_matrices=False)[2]
        axes[2] *= np.sign(np.linalg.det(axes))
        shapes, columns = [(0, 1.0), (0, -1.0)] + [(k, 1.0) for k in range(1, count)], 2
        rows = -(-len(shapes) // columns)
        plotter = pyvista.Plotter(
            off_screen=True, shape=(rows, columns), border=False, window_size=(1040, 330 * rows)
        )
        for number, (k, side) in enumerate(shapes):
            plotter.subplot(number // columns, number % columns)
            turn = axes * np.array([[1.0], [side], [side]])
            mesh = pyvista.make_tri_mesh((arrays["v"] - middle) @ turn.T, arrays["f"])
            mesh["distance"] = arrays[f"e{k}"]
            most = float(arrays["most"])
            plotter.add_mesh(mesh, scalars="distance", cmap="PuOr_r", clim=(-most, most), smooth_shading=True,
                             show_scalar_bar=False)  # fmt: skip
            if number == 0:
                plotter.add_scalar_bar(title="", width=0.5, height=0.07, position_x=0.25,
                                       position_y=0.02, n_labels=3, fmt="%.2g", label_font_size=13,
                                       color="black")  # fmt: skip
            if k == 0 and len(arrays["worst"]):
                places = (arrays["worst"] - middle) @ turn.T
                seen = places[:, 2] >= np.median(mesh.points[:, 2]) - 0.25 * np.ptp(mesh.points[:, 2])
                labels = [str(n + 1) for n in np.flatnonzero(seen)]
                if labels:
                    plotter.add_point_labels(places[seen], labels, font_size=15, text_color="black", point_size=9,
                                             point_color="black", shape=None, render_points_as_spheres=True,
                                             always_visible=True)  # fmt: skip
            words = f"; colours in {arrays['unit']}" if number == 0 else ""
            plotter.add_text(f"{arrays[f't{k}']}{words}", font_size=9, color="black")
            plotter.set_background("white")
            plotter.view_xy()
            plotter.camera.zoom(1.25)
        plotter.screenshot(target)
        plotter.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
