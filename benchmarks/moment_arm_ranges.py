"""Lengths and moment arms of the hip's muscles over flexion, beside published ones and those of OpenSim models.

python benchmarks/moment_arm_ranges.py SCENE [--models rbf,arap-volume] [--osim FILE ...] [-o PICTURE]

SCENE is the hip in flexion (`data/hip/flexion.toml`). With `--osim` the same muscles of gait2392 or of the Rajagopal
model are evaluated by OpenSim itself (`pip install opensim`). Moment arms in mm, positive where the muscle flexes.
"""

import argparse
from pathlib import Path

import numpy as np

# Muscles of the scene; compartments in gait2392 and in the model of Rajagopal et al. (2016).
COMPARTMENTS = {
    "gluteus_maximus": ("glut_max1_r glut_max2_r glut_max3_r", "glmax1_r glmax2_r glmax3_r"),
    "gluteus_medius": ("glut_med1_r glut_med2_r glut_med3_r", "glmed1_r glmed2_r glmed3_r"),
    "iliacus": ("iliacus_r", "iliacus_r"),
    "adductor_brevis": ("add_brev_r", "addbrev_r"),
}
ANGLES = (0, 30, 60, 90)
NONE = float("nan")
# Least and greatest moment arm at these angles [mm], positive in flexion; where each is from: docs/moment_arms.md.
PUBLISHED = {
    "gluteus_maximus": {
        "Blemker and Delp 2005, fibres": ([-66, -72, -68, -59], [NONE, -17, -14, -4]),
        "Németh and Ohlsen 1985": ([NONE, -66, -51, -31],) * 2,
        "Dostal 1986": ([-46, NONE, NONE, NONE],) * 2,
        "Modenese and Kohout 2020, lines": ([-68, -76, -66, -47], [-48, -42, -30, -14]),
    },
    "gluteus_medius": {
        "Blemker and Delp 2005, fibres": ([-14, -16, -10, -2], [NONE, 18, 21, 20]),
        "Modenese and Kohout 2020, lines": ([-19, -18, -13, -6], [-13, -5, 4, 12]),
    },
    "iliacus": {
        "Blemker and Delp 2005, fibres": ([20, 21, 27, 27], [31, 38, 51, 48]),
        "Dostal 1986, iliopsoas": ([18, NONE, NONE, NONE],) * 2,
        "Modenese and Kohout 2020, lines": ([28, 32, 32, 35],) * 2,
    },
    "adductor_brevis": {},
}
FINE = np.arange(0, 91, 2)


def run_curves(path, model):
    """Length and moment arm of each muscle over flexion: dict of name to (angles, lengths, arms)."""
    from rbfmuscle.run import simulate
    from rbfmuscle.sim.scene.scene import Scene

    run = simulate(Scene.load(path), model=model)
    found = {}
    for name in COMPARTMENTS:
        rows = [row for row in run.metrics if row.muscle == name and row.coordinate.endswith("flexion")]
        length = {row.angle: row.value for row in rows if row.quantity == "length"}
        arm = {row.angle: row.value for row in rows if row.quantity == "moment_arm"}
        angles = sorted(set(length) & set(arm))
        found[name] = (
            np.array(angles), np.array([length[a] for a in angles]), np.array([arm[a] for a in angles]),
        )  # fmt: skip
    return found


def osim_curves(path):
    """The same of a model file, for each compartment: dict of name to list of (angles, lengths, arms)."""
    import opensim

    opensim.Logger.setLevelString("error")
    model = opensim.Model(str(path))
    state = model.initSystem()
    flexion = model.getCoordinateSet().get("hip_flexion_r")
    muscles = model.getMuscles()
    known = {muscles.get(i).getName() for i in range(muscles.getSize())}
    found = {}
    for name, choices in COMPARTMENTS.items():
        names = next(parts.split() for parts in choices if set(parts.split()) <= known)
        found[name] = []
        for part in names:
            line = opensim.GeometryPath.safeDownCast(muscles.get(part).getPath())
            lengths, arms = [], []
            for angle in FINE:
                flexion.setValue(state, float(np.radians(angle)))
                model.realizePosition(state)
                lengths.append(1e3 * line.getLength(state))
                arms.append(1e3 * line.computeMomentArm(state, flexion))
            found[name].append((FINE, np.array(lengths), np.array(arms)))
    return found


def at_angles(curve, which, *, relative=False):
    angles, values = curve[0], curve[which]
    values = values / np.interp(0.0, angles, values) if relative else values
    return np.interp(ANGLES, angles, values)


def spread(curves, which, *, relative=False):
    """Least and greatest over compartments at each angle."""
    values = np.array([at_angles(curve, which, relative=relative) for curve in curves])
    return values.min(axis=0), values.max(axis=0)


def table_row(name, source, arms, lengths=None):
    """One line of the table from (least, greatest) at each angle; empty where there is nothing."""
    cells = []
    for values, form in ((arms, "{:.0f}"), (lengths, "{:.2f}")):
        for low, high in zip(*values) if values is not None else [(NONE, NONE)] * len(ANGLES):
            ends = [form.format(end) if np.isfinite(end) else "" for end in (low, high)]
            cells.append(" to ".join(dict.fromkeys(end for end in ends if end)))
    return f"| {name.replace('_', ' ')} | {source} | {' | '.join(cells)} |"


def print_table(sources, models):
    head = " | ".join(f"{angle}°" for angle in ANGLES)
    print(f"| muscle | source | arm {head} | length {head} |\n|" + "---|" * (2 + 2 * len(ANGLES)))
    for name in COMPARTMENTS:
        known = list(PUBLISHED[name].values())
        for source, curves in sources.items():
            arms = spread(curves[name], 2)
            known += [arms] if source not in models else []
            print(table_row(name, source, arms, spread(curves[name], 1, relative=True)))
        for source, arms in PUBLISHED[name].items():
            print(table_row(name, source, arms))
        if known:
            low, high = np.nanmin([k[0] for k in known], axis=0), np.nanmax([k[1] for k in known], axis=0)
            for model in models:
                arm = spread(sources[model][name], 2)[0]
                outside = np.maximum(np.maximum(low - arm, arm - high), 0.0)
                print(table_row(name, f"{model}: outside of all of these by", (outside, outside)))


def draw(sources, file):
    """Moment arms over flexion: lines of the scene's models, bands of the others' compartments."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, len(COMPARTMENTS), figsize=(11, 5), sharex=True, layout="constrained")
    for column, name in enumerate(COMPARTMENTS):
        for k, (source, curves) in enumerate(sources.items()):
            for row, which in enumerate((2, 1)):
                panel, colour = axes[row, column], f"C{k}"
                lines = [c[which] / (c[which][0] if which == 1 else 1.0) for c in curves[name]]
                angles = curves[name][0][0]
                if len(lines) > 1:
                    panel.fill_between(
                        angles, np.min(lines, axis=0), np.max(lines, axis=0), alpha=0.25, color=colour
                    )
                panel.plot(angles, np.mean(lines, axis=0), color=colour, label=source)
        for low, high in PUBLISHED[name].values():
            low, high = np.array(low, dtype=float), np.array(high, dtype=float)
            axes[0, column].vlines(ANGLES, low, high, color="black", lw=1.0)
            single = np.where(np.isfinite(low) & (low == high), low, NONE)
            axes[0, column].plot(ANGLES, single, "k.")
        axes[0, column].set_title(name.replace("_", " "))
        axes[0, column].axhline(0.0, color="grey", lw=0.6)
        axes[1, column].set_xlabel("hip flexion [degree]")
    axes[0, 0].set_ylabel("moment arm [mm]\n(positive: flexes)")
    axes[1, 0].set_ylabel("length / neutral")
    axes[0, 0].plot([], [], "k.-", lw=1.0, label="published")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=6, fontsize=8)
    figure.savefig(file, dpi=75)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--models", default="rbf,arap-volume")
    parser.add_argument("--osim", type=Path, nargs="*", default=[])
    parser.add_argument("-o", "--output", type=Path)
    arguments = parser.parse_args()
    sources = {}
    for model in arguments.models.split(","):
        curves = run_curves(arguments.scene, model)
        sources[model] = {name: [curve] for name, curve in curves.items()}
    for file in arguments.osim:
        sources[file.stem] = osim_curves(file)
    print_table(sources, arguments.models.split(","))
    if arguments.output is not None:
        draw(sources, arguments.output)


if __name__ == "__main__":
    main()
