"""What hangs on what, about what it turns and how far."""

# Class of bone: those that it may hang on, the likeliest first, and the kind of joint between.
PARENTS = {
    "ilium": (("pelvis", "fixed"), ("sacrum", "fixed")),
    "ischium": (("ilium", "fixed"), ("pelvis", "fixed")),
    "pubis": (("ilium", "fixed"), ("pelvis", "fixed")),
    "pelvis": (("pelvis", "fixed"), ("sacrum", "fixed")),
    "sacrum": (("pelvis", "fixed"), ("ilium", "fixed")),
    "femur": (("pelvis", "ball"), ("ilium", "ball"), ("ischium", "ball")),
    "patella": (("femur", "hinge"),),
    "tibia": (("femur", "hinge"),),
    "fibula": (("tibia", "fixed"), ("femur", "hinge")),
    "talus": (("tibia", "hinge"), ("fibula", "hinge")),
    "calcaneus": (("talus", "fixed"), ("tibia", "hinge")),
    "foot": (("calcaneus", "fixed"), ("talus", "fixed"), ("foot", "fixed"), ("tibia", "hinge")),
    "vertebra": (("vertebra", "fixed"), ("sacrum", "fixed"), ("pelvis", "fixed")),
    "scapula": (("clavicle", "fixed"), ("rib", "fixed"), ("sternum", "fixed")),
    "clavicle": (("sternum", "fixed"), ("rib", "fixed")),
    "humerus": (("scapula", "ball"),),
    "ulna": (("humerus", "hinge"),),
    "radius": (("ulna", "fixed"), ("humerus", "hinge")),
    "hand": (("radius", "ball"), ("ulna", "ball"), ("hand", "fixed")),
}
ROOTS = ("pelvis", "ilium", "sacrum", "scapula", "rib", "vertebra", "femur", "humerus", "tibia")
# Class of the child: name of its joint where it hangs on the first of its parents.
JOINTS = {
    "femur": "hip",
    "tibia": "knee",
    "talus": "ankle",
    "patella": "patella",
    "humerus": "shoulder",
    "ulna": "elbow",
}
# Joint: coordinates and ranges [degree] (American Academy of Orthopaedic Surgeons 1965, Joint Motion). Positive as the
# International Society of Biomechanics has it (Wu et al. 2002): flexion, adduction, internal rotation, dorsiflexion.
COORDINATES = {
    "hip": {"flexion": (-30.0, 120.0), "adduction": (-45.0, 30.0), "rotation": (-45.0, 45.0)},
    "knee": {"flexion": (-10.0, 135.0)},
    "ankle": {"dorsiflexion": (-50.0, 20.0)},
    "elbow": {"flexion": (0.0, 150.0)},
}
