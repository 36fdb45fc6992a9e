"""The scenes of data/leg with tendons in place of the carriers, and the patella on its table, in a
work folder.

    python benchmarks/leg_tendons.py OUT [SCENE ...]

A belly that a carrier holds is joined to its bone by a tendon; so are ends of the vasti and the
semimembranosus that stop short of theirs. Insertions and via points were read off the bones of
data/leg (Visible Human Female; CC BY 4.0 and zlib, see its README) at the sites that its
`scene.json` names.
"""

import argparse
import json
import tomllib
from pathlib import Path

import numpy as np
import trimesh
from evidence import data_folder
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from rbfmuscle.scene.file import table_text

HEEL = {"to": [-567.3, -347.0, 133.0]}
PES = {"to": [-597.0, -436.0, 441.0], "via": [[-582.0, -412.0, 470.0]]}
# Muscle and bone of its attachment file: the tendon, and `bone` where another one is its insertion.
TENDONS = {
    "soleus calcaneus": HEEL,
    "gastrocnemius_medial calcaneus": HEEL,
    "gastrocnemius_lateral calcaneus": HEEL,
    "plantaris calcaneus": HEEL,
    "gracilis tibia": PES,
    "semitendinosus tibia": PES,
    "semimembranosus pelvis": {"to": [-603.0, -408.0, 820.0]},
    "semimembranosus tibia": {"to": [-594.0, -411.5, 477.5]},
    "biceps_femoris_long_head pelvis": {"to": [-610.0, -404.5, 827.0]},
    "biceps_femoris_long_head fibula": {"to": [-644.5, -384.2, 470.5]},
    "rectus_femoris patella": {
        "bone": "tibia",
        "to": [-638.5, -450.5, 446.0],
        "via": [
            {"bone": "patella", "point": [-637.0, -478.0, 534.0]},
            {"bone": "patella", "point": [-639.0, -476.0, 489.5]},
        ],
    },
    "vastus_intermedius patella": {"to": [-652.0, -468.0, 529.0]},
    "vastus_medialis patella": {"to": [-621.0, -481.0, 516.0]},
    "vastus_lateralis patella": {"to": [-656.0, -471.0, 521.0]},
    # The belly ends before the femoral head, its tendon at the tip of the lesser trochanter.
    "psoas_major femur": {"to": [-638.5, -426.0, 830.0]},
    "tibialis_anterior foot": {
        "to": [-570.5, -441.5, 97.0],
        "via": [{"bone": "tibia", "point": [-598.0, -432.0, 165.0]}],
    },
    "extensor_hallucis_longus foot": {
        "to": [-584.6, -524.5, 31.0],
        "via": [{"bone": "tibia", "point": [-601.0, -427.0, 151.0]}, [-594.0, -455.0, 109.0]],
    },
    "extensor_digitorum_longus foot": {
        "to": [-596.7, -538.0, 16.0],
        "via": [{"bone": "tibia", "point": [-606.0, -425.0, 148.0]}, [-602.0, -448.0, 110.0]],
    },
    "tibialis_posterior foot": {
        "to": [-567.2, -436.1, 107.8],
        "via": [
            {"bone": "tibia", "point": [-577.0, -390.0, 156.0]},
            {"bone": "talus", "point": [-564.0, -408.0, 140.0]},
        ],
    },
    "flexor_digitorum_longus foot": {
        "to": [-596.7, -531.5, 10.1],
        "via": [
            {"bone": "tibia", "point": [-574.0, -388.0, 156.0]},
            {"bone": "calcaneus", "point": [-564.0, -405.0, 128.0]},
        ],
    },
    "flexor_hallucis_longus foot": {
        "to": [-582.4, -511.5, 19.4],
        "via": [
            {"bone": "talus", "point": [-582.0, -379.5, 148.0]},
            {"bone": "calcaneus", "point": [-568.0, -388.0, 140.0]},
            {"bone": "calcaneus", "point": [-567.0, -389.0, 120.0]},
        ],
    },
    "peroneus_longus foot": {
        "to": [-584.4, -446.8, 70.1],
        "via": [{"bone": "fibula", "point": [-606.5, -376.0, 143.0]}, [-614.8, -411.0, 80.0]],
    },
    "obturator_internus femur": {
        "to": [-653.0, -417.0, 880.0],
        "via": [{"bone": "pelvis", "point": [-619.0, -388.0, 873.0]}],
    },
    # The iliotibial tract, over the vastus lateralis to Gerdy's tubercle.
    "tensor_fasciae_latae femur": {
        "bone": "tibia",
        "to": [-648.2, -438.1, 460.7],
        "via": [
            {"bone": "femur", "point": point}
            for point in (
                [-704.0, -452.0, 760.0],
                [-693.0, -445.0, 680.0],
                [-678.0, -441.0, 600.0],
                [-664.0, -433.0, 530.0],
            )
        ],
    },
    "popliteus femur": {
        "to": [-651.0, -415.0, 495.0],
        "via": [{"bone": "tibia", "point": [-626.5, -398.6, 486.7]}],
    },
}


# Attached vertices nearer than this to the muscle's other end are left free [mm]. Over the lesser
# sciatic notch lies a bursa, and fibres of 16 mm would be stretched by 13 mm in the squat.
FREE_NECK = {"obturator_internus pelvis": 40.0}


def convert(source: Path, out: Path) -> Path:
    """Write a scene of data/leg with tendons; return its file."""
    facts = json.loads((source.parent / "scene.json").read_text(encoding="utf-8"))
    data = tomllib.loads(source.read_text(encoding="utf-8"))
    carriers = set(facts["tendon_carriers"])
    data["bone"] = [bone for bone in data["bone"] if bone["name"] not in carriers]
    bones = {bone["name"] for bone in data["bone"]}
    data["joint"] = [joint for joint in data["joint"] if joint["child"] not in carriers]
    for thing in (*data["bone"], *data["muscle"]):
        thing["mesh"] = str(source.parent / thing["mesh"])
    for muscle in data["muscle"]:
        muscle["attach"] = [
            _attachment(muscle["name"], entry, bones, source.parent) for entry in muscle["attach"]
        ]
    if "file" in data["motion"]:
        data["motion"]["file"] = str(source.parent / data["motion"]["file"])
    ramp = data["motion"].get("ramp", {})
    for name in [
        name for name in ramp if name.endswith(("_slide", "_turn")) or name == "patella_angle"
    ]:
        del ramp[name]
    if any(joint["child"] == "patella" for joint in data["joint"]):
        data["joint"] = [joint for joint in data["joint"] if joint["child"] != "patella"] + [
            _patella(facts)
        ]
        row = {"coordinate": "patella.flexion", "of": ["knee.knee_angle"], "linear": [1, 0]}
        data.setdefault("coupling", []).append(row)
    for muscle in data["muscle"]:
        for entry in muscle["attach"]:
            if f"{muscle['name']} {entry['bone']}" in FREE_NECK:
                entry["vertices"] = _without_neck(muscle, entry)
    path = out / source.name
    path.write_text(_toml(data), encoding="utf-8")
    return path


def _attachment(muscle: str, entry: dict, bones: set[str], folder: Path) -> dict:
    file = Path(entry["vertices"])
    bone = file.stem.removeprefix(f"{muscle}_")
    found = {
        "bone": entry["bone"] if entry["bone"] in bones else bone,
        "vertices": str(folder / file),
    }
    tendon = dict(TENDONS.get(f"{muscle} {bone}", {}))
    if tendon and tendon.get("bone", bone) in bones:
        found["bone"] = tendon.pop("bone", bone)
        found["tendon"] = tendon
    return found


def _without_neck(muscle: dict, entry: dict) -> list[int]:
    """Attached vertices that are not too near to the muscle's other end."""
    vertices = trimesh.load(muscle["mesh"], process=False).vertices
    own = np.loadtxt(entry["vertices"], dtype=int)
    (other,) = [
        np.loadtxt(end["vertices"], dtype=int) for end in muscle["attach"] if end is not entry
    ]
    away = cKDTree(vertices[other]).query(vertices[own])[0]
    return own[away > FREE_NECK[f"{muscle['name']} {entry['bone']}"]].tolist()


def _patella(facts: dict) -> dict:
    """The patella's joint by its table against knee flexion."""
    table = facts["joints"]["patella"]["table"]
    angles, *rest = zip(*table["rows"])
    turns = Rotation.from_rotvec(list(zip(*rest[:3])), degrees=True).as_euler("XYZ", degrees=True).T
    axes = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]

    def rows(values):
        functions = [
            {"x": list(angles), "y": [round(float(v), 4) for v in column]} for column in values
        ]
        return [
            {"axis": axis, "coordinates": ["flexion"], "spline": function}
            for axis, function in zip(axes, functions)
        ]

    return {
        "name": "patella",
        "parent": "femur",
        "child": "patella",
        "type": "custom",
        "centre": table["point_mm"],
        "rotations": rows(turns),
        "translations": rows(rest[3:]),
        "coordinates": {"flexion": {"motion": "rotation"}},
    }


def _toml(data: dict) -> str:
    """Text of the tables of a scene."""
    rows = [
        (f"[[{key}]]" if isinstance(value, list) else f"[{key}]", table)
        for key, value in data.items()
        for table in (value if isinstance(value, list) else [value])
    ]
    return "\n".join(table_text(head, table) for head, table in rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("scenes", nargs="*", default=["squat"])
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    leg = data_folder("leg")
    for name in given.scenes:
        print(convert(leg / f"{name}.toml", given.out))


if __name__ == "__main__":
    main()
