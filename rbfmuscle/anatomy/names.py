"""What names of meshes and labels mean: bone, muscle, tendon or other tissue, which one, and of
which side.

A name is split at capitals, digits and signs; words are brought to one form, those written together
are taken apart, and unknown ones may be misspelt. The table is ``names.toml``, with its sources.
"""

import re
import tomllib
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import NamedTuple

# Fewest letters of a word that may be misspelt, and how much of it must agree with a known one
# (`difflib`'s ratio).
FEWEST, LIKE = 5, 0.8
MIDLINE = ("sacrum", "vertebra", "sternum", "skull", "mandible")
_SIGNS = str.maketrans(
    {"ä": "ae", "ö": "oe", "ü": "ue", "ß": "ss", "é": "e", "è": "e", "ô": "o", "â": "a"}
)


@dataclass(frozen=True)
class MuscleFacts:
    """What a muscle's name says: its name as the table has it, and where it is held.

    ``origin`` and ``insertion`` list attachments: classes of bone that may stand for one, the best
    first, and whether the muscle must be held there.
    """

    name: str
    origin: tuple
    insertion: tuple


@dataclass(frozen=True)
class NameFacts:
    """What a name says.

    ``tissue`` is ``"bone"``, ``"muscle"``, ``"tendon"``, ``"other"`` or empty; ``bone`` the class
    of bone; ``side`` is ``"l"``, ``"r"`` or empty; ``spelling`` says what misspelt words were taken
    for; ``tendon_of`` are the muscles of a tendon, or of a part at the end of muscles.
    """

    tissue: str = ""
    bone: str = ""
    muscle: MuscleFacts | None = None
    side: str = ""
    spelling: str = ""
    tendon_of: tuple[str, ...] = ()


class _Table(NamedTuple):
    """The file, as sets of words: sides and forms by word, names of bones and muscles as tuples of
    words.
    """

    sides: dict[str, str]
    forms: dict[str, str]
    other: set[str]
    bones: dict[tuple, str]
    muscles: dict[tuple, MuscleFacts]
    ends: set[str]
    shared: dict[tuple, tuple[str, ...]]
    groups: dict[str, tuple[str, ...]]
    known: set[str]


@cache
def _table():
    table = tomllib.loads((Path(__file__).parent / "names.toml").read_text(encoding="utf-8"))
    words = dict(entry.strip().split(": ") for entry in table["words"]["table"].split(";"))
    forms = {form: word for word, forms in words.items() for form in forms.split()}
    other = {word for words in table["other"].values() for word in words.split()}

    def key(name):
        return tuple(forms.get(word, word) for word in name.split())

    bones = {key(name): kind for kind, names in table["bones"].items() for name in names.split(",")}
    muscles = {}
    for line in table["muscles"]["table"].strip().splitlines():
        names, *places = (part.strip() for part in line.split(";"))
        for one in names.split(","):
            first, *more = (name.strip() for name in one.split("="))
            for name in (first, *more):
                muscles[key(name)] = MuscleFacts(first, *map(_places, places))
    ends = {word for words in table["ends"].values() for word in words.split()}
    shared = {key(name): _listed(found) for name, found in table["shared"].items()}
    known = {word for name in (*bones, *muscles, *shared) for word in name}
    known |= other | ends | {*forms, *words}
    return _Table(
        sides={form: side for side, forms in table["sides"].items() for form in forms.split()},
        forms=forms,
        other=other,
        bones=bones,
        muscles=muscles,
        ends=ends,
        shared=shared,
        groups={name: _listed(found) for name, found in table["groups"].items()},
        known=known,
    )


def _listed(text):
    return tuple(name.strip() for name in text.split(","))


def _places(text):
    found = re.findall(r"\(?[a-z|]+\)?", text)
    return tuple((tuple(word.strip("()").split("|")), not word.startswith("(")) for word in found)


@cache
def name_facts(name: str) -> NameFacts:
    """What a name says, of a file (without suffix) or of a label."""
    table = _table()
    words, side, spelling = _read_words(name)
    bone, muscle = _longest(words, table.bones), _longest(words, _without_groups(words, table))
    if any(word in table.other and word not in (muscle or ()) for word in words):
        return NameFacts("other", side=side)
    shared = _longest(words, table.shared)
    if shared or table.ends.intersection(words):
        name = table.muscles[muscle].name if muscle else ""
        of = (name, *table.groups.get(name, ())) if name else table.shared.get(shared, ())
        return NameFacts("tendon", side=side, tendon_of=of)
    says_bone, says_muscle = "bone" in words, "muscle" in words
    if bone is not None and muscle is not None:
        more = says_muscle or len(muscle) > len(bone) or set(bone) <= set(muscle)
        bone, muscle = (None, muscle) if more and not says_bone else (bone, None)
    tissue = "muscle" if muscle or says_muscle else "bone" if bone or says_bone else ""
    kind = table.bones[bone] if bone is not None and tissue == "bone" else ""
    used = muscle or bone or ()
    return NameFacts(
        tissue,
        kind,
        muscle=table.muscles[muscle] if muscle else None,
        side="" if kind in MIDLINE else side,
        spelling=", ".join(
            f"{wrong!r} read as {right!r}" for wrong, right in spelling.items() if right in used
        ),
    )


def _without_groups(words, table):
    """The muscles that the words may name, without those of which a part is named too, as the
    quadriceps femoris in "quadriceps, rectus femoris".
    """
    fitting = {key: facts for key, facts in table.muscles.items() if set(words).issuperset(key)}
    named = {facts.name for facts in fitting.values()}
    whole = [
        set(key)
        for key, facts in fitting.items()
        if named.intersection(table.groups.get(facts.name, ()))
    ]
    return {
        key: facts
        for key, facts in fitting.items()
        if not any(group.issuperset(key) for group in whole)
    }


def _longest(words, table):
    """The entry whose words all occur; of several the one with most words, then with the
    longest.
    """
    fitting = [key for key in table if set(words).issuperset(key)]
    return max(fitting, key=lambda key: (len(key), sum(map(len, key))), default=None)


def _read_words(name):
    """Words in their one form, the side, and what misspelt words were taken for."""
    table = _table()
    words = []
    sides = set()
    spelling = {}
    text = re.sub(r"([LTCS])\d{1,2}(?![0-9])", " ", name)  # vertebrae are no sides
    text = re.sub(r"(?<=[a-zäöüß])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", " ", text)
    for word in re.split(r"[^a-z]+", text.lower().translate(_SIGNS)):
        if word in table.sides:
            sides.add(table.sides[word])
            continue
        parts = _taken_apart(word)
        if not parts:
            # The known word of which an unknown one may be a misspelling.
            known = sorted(one for one in table.known if len(one) >= FEWEST)
            found = get_close_matches(word, known, n=1, cutoff=LIKE) if len(word) >= FEWEST else []
            near = found[0] if found else ""
            parts = [near or word]
            if near:
                spelling[word] = table.forms.get(near, near)
        words += [table.forms.get(part, part) for part in parts if part]
    return words, sides.pop() if len(sides) == 1 else "", spelling


def _taken_apart(word):
    """Known words that a word is written together of, none where it is not; the fewest, of three
    letters or more.
    """
    known = _table().known | set(_table().sides)
    if word in known:
        return [word]
    heads = [word[:k] for k in range(3, len(word) - 2) if word[:k] in known]
    found = [[head, *rest] for head in heads if (rest := _taken_apart(word[len(head) :]))]
    return min(found, key=len, default=[])
