"""Moment arms of the leg's muscles at hip, knee and ankle, beside published measurements and an OpenSim model's.

    python benchmarks/leg_arms.py [--models rbf,pbd] [--osim gait2392_simbody.osim] [--joints hip,knee,ankle]

One joint moves at a time, with the kneecap and the tendon carriers that it drives (`data/leg/squat.toml`); the arm is
minus the change of a muscle's centreline with the joint's angle. Where a carrier holds an end it goes as far as the
tendon would, so the belly changes by as much as muscle and tendon together. Arms in mm: least to greatest over the
range; positive where the muscle flexes hip or knee, or dorsiflexes the ankle.
"""

import argparse
from pathlib import Path

import numpy as np
from evidence import data_folder

from rbfmuscle.run import simulate
from rbfmuscle.scene.objects import Motion
from rbfmuscle.scene.scene import Scene

# Leading coordinate; those that go along (those of the squat, to its end); range of clinical angles that is compared.
JOINTS = {
    "hip": ("hip.hip_flexion", ("obturator_internus", "hamstring"), 5.0),
    "knee": (
        "knee.knee_angle",
        ("patella", "quadriceps", "pes_anserinus", "biceps_femoris", "popliteus"),
        5.0,
    ),
    "ankle": ("ankle.ankle_angle", ("achilles", "tibialis", "extensor", "flexor_hallucis", "peroneus"), 4.0),
}
# Clinical angle = coordinate + this (data/leg/README.md); sign of the OpenSim coordinate against ours.
OFFSET = {"hip": -3.7, "knee": -0.5, "ankle": -32.0}
OSIM = {"hip": ("hip_flexion_r", 1.0), "knee": ("knee_angle_r", -1.0), "ankle": ("ankle_angle_r", 1.0)}
# Muscle: its compartments in gait2392.
HIP = {
    "gluteus_maximus": "glut_max1_r glut_max2_r glut_max3_r", "iliacus": "iliacus_r", "psoas_major": "psoas_r",
    "rectus_femoris": "rect_fem_r", "sartorius": "sar_r", "tensor_fasciae_latae": "tfl_r",
    "adductor_longus": "add_long_r", "adductor_magnus": "add_mag1_r add_mag2_r add_mag3_r",
    "semimembranosus": "semimem_r", "semitendinosus": "semiten_r", "biceps_femoris_long_head": "bifemlh_r",
}  # fmt: skip
KNEE = {
    "rectus_femoris": "rect_fem_r", "vastus_lateralis": "vas_lat_r", "vastus_medialis": "vas_med_r",
    "semimembranosus": "semimem_r", "semitendinosus": "semiten_r", "biceps_femoris_long_head": "bifemlh_r",
    "biceps_femoris_short_head": "bifemsh_r", "gracilis": "grac_r", "sartorius": "sar_r",
    "gastrocnemius_medial": "med_gas_r", "gastrocnemius_lateral": "lat_gas_r",
}  # fmt: skip
ANKLE = {
    "soleus": "soleus_r", "gastrocnemius_medial": "med_gas_r", "gastrocnemius_lateral": "lat_gas_r",
    "tibialis_anterior": "tib_ant_r", "extensor_digitorum_longus": "ext_dig_r",
    "extensor_hallucis_longus": "ext_hal_r", "tibialis_posterior": "tib_post_r",
    "flexor_hallucis_longus": "flex_hal_r", "peroneus_longus": "per_long_r",
}  # fmt: skip
MUSCLES = {"hip": HIP, "knee": KNEE, "ankle": ANKLE}
# Least and greatest published arm [mm] over about the same range; sources in docs/moment_arms.md.
PUBLISHED = {
    ("hip", "gluteus_maximus"): (-68, -31, "Németh and Ohlsen 1985; Dostal et al. 1986"),
    ("hip", "iliacus"): (18, 51, "Dostal et al. 1986; Blemker and Delp 2005"),
    ("knee", "rectus_femoris"): (-50, -20, "Wilson and Sheehan 2009, patellar tendon"),
    ("knee", "vastus_lateralis"): (-50, -20, "Wilson and Sheehan 2009, patellar tendon"),
    ("knee", "vastus_medialis"): (-50, -20, "Wilson and Sheehan 2009, patellar tendon"),
    ("knee", "semimembranosus"): (20, 40, "Spoor and van Leeuwen 1992, as in Tözeren 2000"),
    ("knee", "semitendinosus"): (40, 55, "Spoor and van Leeuwen 1992, as in Tözeren 2000"),
    ("knee", "biceps_femoris_long_head"): (20, 20, "Spoor and van Leeuwen 1992, as in Tözeren 2000"),
    ("knee", "gastrocnemius_medial"): (12, 20, "Spoor et al. 1990, as in Tözeren 2000"),
    ("knee", "gastrocnemius_lateral"): (12, 20, "Spoor et al. 1990, as in Tözeren 2000"),
    ("ankle", "soleus"): (-57, -35, "Achilles tendon, 17 studies in Manal et al. 2013"),
    ("ankle", "gastrocnemius_medial"): (-57, -35, "Achilles tendon, 17 studies in Manal et al. 2013"),
    ("ankle", "gastrocnemius_lateral"): (-57, -35, "Achilles tendon, 17 studies in Manal et al. 2013"),
    ("ankle", "tibialis_anterior"): (29, 45, "Maganaris 2000"),
}


def joint_scene(folder, joint):
    """The squat's scene with one joint moving through the squat's range, and the muscles that cross it."""
    scene = Scene.load(folder / "leg" / "squat.toml")
    leading, along, step = JOINTS[joint]
    last = scene.motion.frames[-1]
    moving = {
        name: end for name, end in last.items() if name == leading or any(part in name for part in along)
    }
    if joint == "knee":
        moving.pop("tibialis_anterior.tibialis_anterior_slide", None)
    count = round(np.degrees(last[leading]) / step)
    scene.motion = Motion([{name: end * k / count for name, end in moving.items()} for k in range(count + 1)])
    scene.muscles = [muscle for muscle in scene.muscles if muscle.name in MUSCLES[joint]]
    return scene.with_options({"output.surfaces": False, "output.report": False}), leading


def our_arms(folder, joint, model):
    """Arm of each muscle between neighbouring frames: dict of name to (angles [degree], arms [mm])."""
    scene, leading = joint_scene(folder, joint)
    run = simulate(scene, model=model)
    angles = np.array([frame.coordinates[leading] for frame in run.frames])
    found = {}
    for muscle in scene.muscles:
        lengths = run.values(muscle.name, "length")
        found[muscle.name] = 0.5 * np.degrees(angles[1:] + angles[:-1]), -np.diff(lengths) / np.diff(angles)
    return found


def osim_arms(path, joint, angles):
    """The same of an OpenSim model at clinical angles: dict of name to arms (compartments, angles) [mm]."""
    import opensim

    opensim.Logger.setLevelString("error")
    model = opensim.Model(str(path))
    state = model.initSystem()
    name, sign = OSIM[joint]
    coordinate, muscles = model.getCoordinateSet().get(name), model.getMuscles()
    found = {}
    for muscle, parts in MUSCLES[joint].items():
        rows = []
        for part in parts.split():
            line = opensim.GeometryPath.safeDownCast(muscles.get(part).getPath())
            row = []
            for angle in angles:
                coordinate.setValue(state, float(sign * np.radians(angle)))
                model.realizePosition(state)
                row.append(1e3 * sign * line.computeMomentArm(state, coordinate))
            rows.append(row)
        found[muscle] = np.array(rows)
    return found


def span(values):
    low, high = float(np.min(values)), float(np.max(values))
    return f"{low:.0f} to {high:.0f}"


def outside(values, low, high):
    """How far the mean arm lies outside a published range [mm]."""
    mean = float(np.mean(values))
    return max(low - mean, mean - high, 0.0)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--models", default="rbf,pbd")
    parser.add_argument("--osim", type=Path)
    parser.add_argument("--joints", default="hip,knee,ankle")
    arguments = parser.parse_args()
    folder, models = data_folder("leg").parent, arguments.models.split(",")
    osim = arguments.osim or folder / "osim" / "gait2392" / "gait2392_thelen2003muscle.osim"
    print(
        f"| joint | muscle | {' | '.join(models)} | gait2392 | published | source | {models[0]}: mean outside by |"
    )
    print("|" + "---|" * (6 + len(models)))
    for joint in arguments.joints.split(","):
        ours = {model: our_arms(folder, joint, model) for model in models}
        angles = next(iter(ours[models[0]].values()))[0] + OFFSET[joint]
        theirs = osim_arms(osim, joint, angles)
        for muscle in MUSCLES[joint]:
            low, high, source = PUBLISHED.get((joint, muscle), (None, None, ""))
            cells = [span(ours[model][muscle][1]) for model in models]
            published = "" if low is None else f"{low} to {high}" if low != high else f"{low}"
            range_ = (low, high) if low is not None else (theirs[muscle].min(), theirs[muscle].max())
            beyond = outside(ours[models[0]][muscle][1], *range_)
            shown = f"{beyond:.0f}" if low is not None else f"{beyond:.0f} (gait2392)"
            name = muscle.replace("_", " ")
            row = [joint, name, *cells, span(theirs[muscle]), published, source, shown]
            print(f"| {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    main()
