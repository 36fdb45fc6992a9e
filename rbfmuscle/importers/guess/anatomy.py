"""Names of bones and muscles as segmentation programs and people write them, and what they tell.

Attachments follow the usual textbook descriptions (Gray's Anatomy, 41st edition, chapters on the limbs); where
a bone is often not part of a data set, the bone that carries its part of the body stands behind it.
"""

import re
from dataclasses import dataclass

SIDES = {
    **dict.fromkeys(("l", "left", "lt", "links", "li", "gauche", "sin", "sinister", "sinistra"), "l"),
    **dict.fromkeys(("r", "right", "rt", "rechts", "re", "droite", "droit", "dex", "dexter", "dextra"), "r"),
}

# Class of bone: words that name it (English, Latin, German, French; numbers and sides are cut off before).
BONES = {
    "pelvis": "pelvis hip_bone hipbone hip coxa coxae os_coxae innominate hueftbein huefte becken bassin",
    "ilium": "ilium os_ilium darmbein",
    "ischium": "ischium os_ischii sitzbein",
    "pubis": "pubis os_pubis schambein",
    "sacrum": "sacrum kreuzbein os_sacrum",
    "femur": "femur oberschenkelknochen os_femoris thigh_bone",
    "patella": "patella kniescheibe rotule kneecap",
    "tibia": "tibia schienbein shin_bone shinbone",
    "fibula": "fibula wadenbein",
    "talus": "talus sprungbein astragalus",
    "calcaneus": "calcaneus fersenbein heel_bone calcn calcn_bone",
    "foot": "foot fuss pied toes toe metatarsal metatarsals tarsal tarsals cuboid navicular phalanges_foot",
    "vertebra": "vertebra vertebrae spine lumbar wirbel wirbelsaeule torso",
    "rib": "rib ribs ribcage thorax rippe rippen cote",
    "sternum": "sternum brustbein",
    "skull": "skull cranium schaedel crane",
    "mandible": "mandible mandibula unterkiefer jaw",
    "scapula": "scapula schulterblatt omoplate",
    "clavicle": "clavicle clavicula clavicula schluesselbein",
    "humerus": "humerus oberarmknochen",
    "ulna": "ulna elle cubitus",
    "radius": "radius speiche",
    "hand": "hand main metacarpal metacarpals carpal carpals lunate capitate phalanges_hand",
    "bone": "bone knochen os",
}
# Class of bone: those that it may hang on, the likeliest first, and the kind of joint between.
PARENTS = {
    "ilium": (("pelvis", "fixed"), ("sacrum", "fixed")),
    "ischium": (("ilium", "fixed"), ("pelvis", "fixed")),
    "pubis": (("ilium", "fixed"), ("pelvis", "fixed")),
    "sacrum": (("pelvis", "fixed"), ("ilium", "fixed")),
    "femur": (("pelvis", "ball"), ("ilium", "ball"), ("ischium", "ball")),
    "patella": (("femur", "hinge"),),
    "tibia": (("femur", "hinge"),),
    "fibula": (("tibia", "fixed"), ("femur", "hinge")),
    "talus": (("tibia", "hinge"), ("fibula", "hinge")),
    "calcaneus": (("talus", "fixed"), ("tibia", "hinge")),
    "foot": (("calcaneus", "fixed"), ("talus", "fixed"), ("tibia", "hinge")),
    "vertebra": (("sacrum", "fixed"), ("pelvis", "fixed")),
    "scapula": (("clavicle", "fixed"), ("rib", "fixed"), ("sternum", "fixed")),
    "clavicle": (("sternum", "fixed"), ("rib", "fixed")),
    "humerus": (("scapula", "ball"),),
    "ulna": (("humerus", "hinge"),),
    "radius": (("ulna", "fixed"), ("humerus", "hinge")),
    "hand": (("radius", "ball"), ("ulna", "ball")),
}
ROOTS = ("pelvis", "ilium", "sacrum", "scapula", "rib", "vertebra", "femur", "humerus", "tibia")

# Muscle: words; origin; insertion. "a|b": b where there is no a. "(a)": only where the muscle lies on it.
_MUSCLES = """
adductor brevis; pelvis|pubis; femur
adductor longus; pelvis|pubis; femur
adductor magnus; pelvis|ischium; femur
adductor minimus; pelvis|ischium; femur
adductor; pelvis|ischium; femur
biceps femoris short head, biceps femoris brevis, bfsh, bicfemsh; femur; fibula|tibia
biceps femoris long head, biceps femoris longus, biceps femoris, bflh, bicfemlh; pelvis|ischium; fibula|tibia
extensor digitorum longus, edl, extdig; fibula (tibia); foot|calcaneus
extensor hallucis longus, ehl, exthal; fibula; foot|calcaneus
flexor digitorum longus, fdl, flexdig; tibia; foot|calcaneus
flexor hallucis longus, fhl, flexhal; fibula; foot|calcaneus
gastrocnemius lateral, gastrocnemius medial, gastrocnemius, gaslat, gasmed, lat gas, med gas; femur; calcaneus|foot
gluteus maximus, glutaeus maximus, glmax, glut max; pelvis|ilium (sacrum); femur
gluteus medius, glutaeus medius, glmed, glut med; pelvis|ilium; femur
gluteus minimus, glutaeus minimus, glmin, glut min; pelvis|ilium; femur
gracilis, grac; pelvis|pubis; tibia
iliacus; pelvis|ilium; femur
iliopsoas; vertebra|pelvis|ilium; femur
psoas major, psoas minor, psoas; vertebra|pelvis|ilium; femur
gemellus inferior, inferior gemellus, gemellus superior, superior gemellus, gemellus, gem; pelvis|ischium; femur
obturator externus, obturator internus, obturator; pelvis|ischium; femur
pectineus, pect; pelvis|pubis; femur
peroneus longus, fibularis longus, perlong, per long; fibula (tibia); foot|calcaneus
peroneus brevis, fibularis brevis, perbrev, peroneus tertius, fibularis tertius; fibula; foot|calcaneus
piriformis, peri; sacrum|pelvis; femur
plantaris; femur; calcaneus|foot
popliteus; tibia; femur
quadratus femoris, quad fem; pelvis|ischium; femur
rectus femoris, recfem, rect fem; pelvis|ilium; patella|tibia
sartorius, sart; pelvis|ilium; tibia
semimembranosus, semimem; pelvis|ischium; tibia
semitendinosus, semiten; pelvis|ischium; tibia
soleus; fibula (tibia); calcaneus|foot
tensor fasciae latae, tensor fascia lata, tfl, tensor; pelvis|ilium; femur|tibia
tibialis anterior, tib ant, tibant; tibia; foot|calcaneus
tibialis posterior, tib post, tibpost; tibia fibula; foot|calcaneus
vastus intermedius, vasint, vas int; femur; patella|tibia
vastus lateralis, vaslat, vas lat; femur; patella|tibia
vastus medialis, vasmed, vas med; femur; patella|tibia
quadriceps; femur; patella|tibia
deltoid, deltoideus; scapula (clavicle); humerus
supraspinatus, infraspinatus, subscapularis, teres major, teres minor, coracobrachialis; scapula; humerus
pectoralis major; sternum|rib (clavicle); humerus
pectoralis minor, serratus anterior; rib; scapula
latissimus dorsi; vertebra|pelvis; humerus
trapezius, rhomboideus, rhomboid, levator scapulae; vertebra; scapula
biceps brachii, biceps; scapula|humerus; radius|ulna
triceps brachii, triceps; humerus (scapula); ulna
brachialis; humerus; ulna
brachioradialis; humerus; radius
pronator teres, supinator; humerus|ulna; radius
quadratus lumborum; pelvis|ilium; rib|vertebra
erector spinae, autochthon, multifidus; sacrum|pelvis; vertebra|rib
"""


@dataclass(frozen=True)
class MuscleFacts:
    """What a muscle's name tells.

    Attributes
    ----------
    name : str
        As the table has it.
    origin, insertion : tuple of (tuple of str, bool)
        Classes of bone that may stand for one attachment, the best first; whether the muscle must be held there.
    """

    name: str
    origin: tuple
    insertion: tuple


def _places(text):
    places = []
    for word in re.findall(r"\(?[a-z|]+\)?", text):
        places.append((tuple(word.strip("()").split("|")), not word.startswith("(")))
    return tuple(places)


def _read_table():
    facts = {}
    for line in _MUSCLES.strip().splitlines():
        names, origin, insertion = (part.strip() for part in line.split(";"))
        for name in names.split(","):
            facts[tuple(name.split())] = MuscleFacts(name.strip(), _places(origin), _places(insertion))
    return facts


MUSCLES = _read_table()
_BONE_WORDS = {tuple(word.split("_")): kind for kind, words in BONES.items() for word in words.split()}
MUSCLE_WORDS = frozenset({"muscle", "muskel", "musculus", "m"})


def words_of(name: str) -> list[str]:
    """Words of a file's name, lower case: split at capitals, digits and signs."""
    text = re.sub(r"([a-zäöü])([A-Z])", r"\1_\2", name)
    text = text.lower().replace("ä", "ae").replace("ö", "oe").replace("ü", "ue").replace("é", "e")
    return [word for word in re.split(r"[^a-z]+", text) if word]


def side_of(name: str) -> str:
    """``"l"``, ``"r"`` or ``""``: which side of the body a name says."""
    found = {SIDES[word] for word in words_of(name) if word in SIDES}
    return found.pop() if len(found) == 1 else ""


def _longest(words, table):
    """Entry whose words all occur in a name; the one with most words, then with the longest."""
    present = set(words)
    fitting = [key for key in table if present.issuperset(key)]
    return table[max(fitting, key=lambda key: (len(key), sum(map(len, key))))] if fitting else None


def bone_class(name: str) -> str:
    """Class of bone that a name says, ``""`` where it says none."""
    words = [word for word in words_of(name) if word not in SIDES]
    return _longest(words, _BONE_WORDS) or ""


def muscle_facts(name: str) -> MuscleFacts | None:
    """What a muscle's name tells of its attachments, or None."""
    return _longest([word for word in words_of(name) if word not in SIDES], MUSCLES)


def says_muscle(name: str) -> bool:
    """Whether a name is that of a muscle; "quadratus femoris" is, though it names a bone too."""
    return muscle_facts(name) is not None or not MUSCLE_WORDS.isdisjoint(words_of(name))
