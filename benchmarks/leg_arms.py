"""Moment arms of the leg's muscles at hip, knee and ankle, beside OpenSim's gait2392 and published
measurements.

    python benchmarks/leg_arms.py [--models rbf,pbd] [--joints hip,knee,ankle]

One joint moves at a time through the squat's range, in the scene with tendons of
``leg_tendons.py``. The arm is minus the change of length from bone to bone with the joint's angle,
in mm; positive where the muscle flexes hip or knee, or dorsiflexes the ankle. "Geodesic" is the
same of the shortest path over the bones between the belly's ends, with the tendons: where it
departs from gait2392, attachments or joints differ and not the muscle's shape. gait2392's arms
(mean over a muscle's paths) are those of `reference/anatomy`, beside the data.
"""

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np
from evidence import data_folder, write_evidence
from leg_tendons import convert

from rbfmuscle.recording import simulate
from rbfmuscle.scene.objects import Motion
from rbfmuscle.scene.scene import Scene

# Coordinate that moves, and steps [degree].
JOINTS = {
    "hip": ("hip.hip_flexion", 5.0),
    "knee": ("knee.knee_angle", 5.0),
    "ankle": ("ankle.ankle_angle", 4.0),
}
# Clinical angle = coordinate + this (data/leg/README.md).
OFFSET = {"hip": -3.7, "knee": -0.5, "ankle": -32.0}
MUSCLES = {
    "hip": "gluteus_maximus iliacus psoas_major rectus_femoris sartorius tensor_fasciae_latae "
    "adductor_longus "
    "adductor_magnus semimembranosus semitendinosus biceps_femoris_long_head",
    "knee": "rectus_femoris vastus_lateralis vastus_medialis semimembranosus semitendinosus "
    "biceps_femoris_long_head "
    "biceps_femoris_short_head gracilis sartorius gastrocnemius_medial gastrocnemius_lateral",
    "ankle": "soleus gastrocnemius_medial gastrocnemius_lateral tibialis_anterior "
    "extensor_digitorum_longus "
    "extensor_hallucis_longus tibialis_posterior flexor_hallucis_longus peroneus_longus",
}
AGREES = (
    10.0  # mm, on average: a geodesic nearer to gait2392 than this has its attachments and joints
)
# Least and greatest published arm [mm] over about the same range.
PUBLISHED = {
    ("hip", "gluteus_maximus"): (-68, -31, "Németh and Ohlsen 1985; Dostal et al. 1986"),
    ("hip", "iliacus"): (18, 51, "Dostal et al. 1986; Blemker and Delp 2005"),
    ("knee", "rectus_femoris"): (-50, -20, "Wilson and Sheehan 2009, patellar tendon"),
    ("knee", "vastus_lateralis"): (-50, -20, "Wilson and Sheehan 2009, patellar tendon"),
    ("knee", "vastus_medialis"): (-50, -20, "Wilson and Sheehan 2009, patellar tendon"),
    ("knee", "semimembranosus"): (20, 40, "Spoor and van Leeuwen 1992, as in Tözeren 2000"),
    ("knee", "semitendinosus"): (40, 55, "Spoor and van Leeuwen 1992, as in Tözeren 2000"),
    ("knee", "biceps_femoris_long_head"): (
        20,
        20,
        "Spoor and van Leeuwen 1992, as in Tözeren 2000",
    ),
    ("knee", "gastrocnemius_medial"): (12, 20, "Spoor et al. 1990, as in Tözeren 2000"),
    ("knee", "gastrocnemius_lateral"): (12, 20, "Spoor et al. 1990, as in Tözeren 2000"),
    ("ankle", "soleus"): (-57, -35, "Achilles tendon, 17 studies in Manal et al. 2013"),
    ("ankle", "gastrocnemius_medial"): (
        -57,
        -35,
        "Achilles tendon, 17 studies in Manal et al. 2013",
    ),
    ("ankle", "gastrocnemius_lateral"): (
        -57,
        -35,
        "Achilles tendon, 17 studies in Manal et al. 2013",
    ),
    ("ankle", "tibialis_anterior"): (29, 45, "Maganaris 2000"),
}


def joint_scene(file, joint):
    """The scene with one joint moving through the squat's range, and the muscles of the table that
    cross it.
    """
    scene = Scene.load(file)
    coordinate, step = JOINTS[joint]
    last = scene.motion.frames[-1][coordinate]
    count = round(np.degrees(last) / step)
    scene.motion = Motion([{coordinate: last * k / count} for k in range(count + 1)])
    scene.muscles = [muscle for muscle in scene.muscles if muscle.name in MUSCLES[joint].split()]
    return scene


def our_arms(scene, joint, model):
    """Arms of each muscle between neighbouring frames, by length and by geodesic: name to ((n,),
    (n,)) [mm].
    """
    run = simulate(scene, model=model)
    angles = np.array([frame.coordinates[JOINTS[joint][0]] for frame in run.frames])
    found = {}
    for muscle in scene.muscles:
        lengths, bowing = run.values(muscle.name, "length"), run.values(muscle.name, "bowing")
        tendons = sum(end.length for end in muscle.tendons)
        shortest = tendons + (lengths - tendons) / bowing
        found[muscle.name] = tuple(
            -np.diff(values) / np.diff(angles) for values in (lengths, shortest)
        )
    return np.degrees(angles[1:] + angles[:-1]) / 2 + OFFSET[joint], found


def span(values):
    return f"{np.min(values):.0f} to {np.max(values):.0f}"


def verdict(ours, theirs):
    """Whether arms agree with gait2392's in sign and within a factor of two, by their means."""
    ratio = np.mean(ours) / np.mean(theirs)
    return (
        "wrong sign"
        if ratio < 0
        else "beyond a factor of two"
        if not 0.5 <= ratio <= 2
        else "within"
    )


COLUMNS = [
    "moment arms compared",
    "shortest path over the bones within 10 mm",
    "of these, mean within a factor of two",
    "mean difference of these",
    "of their shortest paths",
]


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--models", default="rbf")
    parser.add_argument("--joints", default="hip,knee,ankle")
    parser.add_argument("-o", "--output", help="file of evidence for the pages")
    arguments = parser.parse_args()
    leg, models = data_folder("leg"), arguments.models.split(",")
    reference = leg.parent.parent / "reference" / "anatomy" / "gait2392_moment_arms.json"
    if not reference.is_file():
        raise SystemExit(f"{reference} is not here: it lies beside the folder of the data")
    theirs = json.loads(reference.read_text(encoding="utf-8"))
    heads = [
        *models,
        f"geodesic of {models[0]}",
        "gait2392",
        "published",
        "mean difference from gait2392",
        "of the geodesic",
        "",
    ]
    print(f"| joint | muscle | {' | '.join(heads)} |")
    print("|" + "---|" * (2 + len(heads)))
    differences, verdicts = [], []  # of arms and of geodesics
    with tempfile.TemporaryDirectory() as folder:
        file = convert(leg / "squat.toml", Path(folder))
        for joint in arguments.joints.split(","):
            results = {model: our_arms(joint_scene(file, joint), joint, model) for model in models}
            angles, first = results[models[0]]
            for muscle, (arms, geodesic) in first.items():
                low, high, source = PUBLISHED.get((joint, muscle), ("", "", ""))
                cells = [span(results[model][1][muscle][0]) for model in models]
                row = [joint, muscle.replace("_", " "), *cells, span(geodesic)]
                published = f"{low} to {high} ({source})" if source else ""
                at, means = theirs.get(f"{joint}/{muscle}", ([], []))[:2]
                if at:
                    inside = (angles >= min(at) - 5) & (angles <= max(at) + 5)
                    compared = np.interp(angles[inside], at, means)
                    mean, of_geodesic = (
                        np.mean(np.abs(a[inside] - compared)) for a in (arms, geodesic)
                    )
                    same = of_geodesic <= AGREES
                    differences += [(mean, of_geodesic)] if same else []
                    result = verdict(arms[inside], compared) if same else "geodesic differs"
                    row += [span(compared), published, f"{mean:.0f}", f"{of_geodesic:.0f}", result]
                    verdicts.append(result)
                else:
                    row += ["", published, "", "", ""]
                print(f"| {' | '.join(row)} |", flush=True)
    means = np.mean(differences, axis=0).tolist() if differences else [None, None]
    if differences:
        print(
            f"mean difference of the {len(differences)} whose geodesic agrees: "
            f"{means[0]:.1f} mm, of their geodesics {means[1]:.1f} mm"
        )
    if arguments.output:
        cells = [len(verdicts), len(differences), verdicts.count("within"), *means]
        write_evidence(arguments.output, ["benchmarks/leg_arms.py"], [cells], COLUMNS)


if __name__ == "__main__":
    main()
