"""Pages made before Sphinx runs: the gallery from ``examples/``, the reference from the public
names.
"""

import ast
import json
import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

# In the order of the gallery.
EXAMPLES = (
    "first_muscle",
    "own_meshes",
    "from_labels",
    "choosing_a_kernel",
    "rbf_against_pbd",
    "tunnelling",
    "touching",
    "sweep",
    "exporting",
)
# The Python reference: public names by topic.
TOPICS = {
    "Scenes": ("Scene", "phantom_scene", "check_scene"),
    "Running and comparing": (
        "simulate",
        "Run",
        "compare",
        "sweep",
        "show",
        "discretisation_error",
    ),
    "Fields and kernels": ("RBFField", "study_kernels", "reach_error", "register_kernel"),
    "Muscles and bones": ("RBFMuscle", "BoneSDF", "ModelKind", "model_kind", "register_model"),
    "Errors and warnings": (
        "RBFMuscleError",
        "UsageError",
        "SceneError",
        "MeshError",
        "SolveError",
        "LimitExceededError",
        "MissingDependencyError",
        "NumericalWarning",
        "SceneWarning",
    ),
}
PAGES = ("../leg",)  # of the gallery too, on data that are not in the repository
_TIMEOUT = 600
_LONGEST = 60  # lines of an example's output that are shown


def write_gallery(root):
    """Run the examples and write ``docs/gallery/*.md`` with their text, pictures, output and code.

    An example that is older than its page is not run again.

    Parameters
    ----------
    root : pathlib.Path
        Of the project.

    Raises
    ------
    RuntimeError
        If an example fails.
    """
    folder = root / "docs" / "gallery"
    folder.mkdir(exist_ok=True)
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(lambda name: _write_page(root, folder, name), EXAMPLES))
    listed = "\n".join([*EXAMPLES, *PAGES])
    (folder / "index.md").write_text(
        "# Gallery\n\nEach page is a script or a notebook of `examples/`, run when these pages "
        "were built, and ends with a check of its own result; the last shows data that are not in "
        f"this repository.\n\n```{{toctree}}\n:maxdepth: 1\n\n{listed}\n```\n",
        encoding="utf-8",
    )


def find_example(root, name):
    """Path of an example: a script, or a notebook."""
    return next(
        path for path in (root / "examples").glob(f"{name}.*") if path.suffix in (".py", ".ipynb")
    )


def read_example(path):
    """Text of an example, which begins with its title, and its code; of a notebook all cells of
    either kind.
    """
    source = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        return ast.get_docstring(ast.parse(source)), source.split('"""\n', 1)[1].strip()
    cells = json.loads(source)["cells"]
    text, code = (
        "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == kind)
        for kind in ("markdown", "code")
    )
    return text, code


def run_example(path, pictures):
    """Run an example's code in its folder, with where its files go; the finished process."""
    return subprocess.run(
        [sys.executable, "-c", read_example(path)[1], str(pictures)],
        cwd=path.parent,
        capture_output=True,
        text=True,
        timeout=_TIMEOUT,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
        check=False,
    )


def _write_page(root, folder, name):
    example, page = find_example(root, name), folder / f"{name}.md"
    if page.exists() and page.stat().st_mtime > example.stat().st_mtime:
        return
    pictures = folder / name
    shutil.rmtree(pictures, ignore_errors=True)
    done = run_example(example, pictures)
    if done.returncode != 0:
        raise RuntimeError(f"examples/{example.name} failed:\n{done.stderr[-2000:]}")
    text, code = read_example(example)
    shown = "\n\n".join(
        f"![{path.stem.replace('_', ' ')}]({name}/{path.name})"
        for path in sorted(pictures.glob("*.png"))
    )
    output = (
        done.stdout.replace(str(pictures), name).replace(str(root), ".").splitlines()[:_LONGEST]
    )
    parts = [
        text,
        shown,
        "\n".join(["```text", *output, "```"]),
        f"## The code\n\n```python\n{code}\n```\n",
    ]
    page.write_text("\n\n".join(parts), encoding="utf-8")


def write_reference(root, package):
    """Write ``docs/gallery/reference.md``: every public name with its docstring.

    Parameters
    ----------
    root : pathlib.Path
    package : module
    """
    folder = root / "docs" / "gallery"
    folder.mkdir(exist_ok=True)
    public = sorted(set(package.__all__) - {"__version__"})
    known = {name for names in TOPICS.values() for name in names}
    topics = {**TOPICS, "Besides": tuple(name for name in public if name not in known)}
    lines = [
        "# Python reference",
        "",
        "The public names of `rbfmuscle` by topic; each is loaded when first used.",
        "",
    ]
    for topic, names in topics.items():
        if names:
            lines += [f"## {topic}", ""]
        for name in names:
            value = getattr(package, name)
            kind, options = "autofunction", ""
            if isinstance(value, type):  # with what it has from a class of the package
                kind = "autoclass"
                options = "   :members:\n   :inherited-members: BaseException\n"
            directive = f".. {kind}:: {value.__module__}.{name}\n{options}"
            lines += [f"### {name}", "", f"```{{eval-rst}}\n{directive}```", ""]
    (folder / "reference.md").write_text("\n".join(lines), encoding="utf-8")


def write_scene_reference(root):
    """Write ``docs/gallery/scene_reference.md``: every table and key of a scene file, from the
    schema itself.

    Parameters
    ----------
    root : pathlib.Path
    """
    from pbd_baseline.rest import PBDOptions
    from rbfmuscle.muscle.rest import RBFOptions
    from rbfmuscle.scene.file import SceneFile

    schema = SceneFile.model_json_schema()
    models = [
        (options.__name__, options.model_json_schema()) for options in (RBFOptions, PBDOptions)
    ]
    lines = [
        "# Scene file: every key",
        "",
        "Made from the schema that checks a scene. What the keys mean is under [scene "
        "files](../scene_file.md).",
        "",
    ]
    for name, table in [("SceneFile", schema), *schema["$defs"].items(), *models]:
        required = set(table.get("required", ()))
        rows = [
            (key, _allowed(field), "required" if key in required else _value(field.get("default")))
            for key, field in table["properties"].items()
        ]
        lines += _table(name, table.get("description", ""), rows)
    (root / "docs" / "gallery" / "scene_reference.md").write_text(
        "\n".join(lines), encoding="utf-8"
    )


def _table(name, meaning, rows):
    text = " ".join(meaning.replace("``", "`").split())
    body = [
        f"| `{key}` | {allowed.replace('|', 'or')} | {default} |" for key, allowed, default in rows
    ]
    return [
        f"## {name}",
        "",
        text,
        "",
        "| key | what is allowed | default |",
        "|---|---|---|",
        *body,
        "",
    ]


def _allowed(field):
    """What a field of a JSON schema may hold, in words; True is the schema of anything."""
    if field is True:
        return "any"
    if "$ref" in field:
        name = field["$ref"].rsplit("/", 1)[-1]
        return f"table [{name}](#{name.lower()})"
    for several in ("anyOf", "oneOf"):
        if several in field:
            parts = [_allowed(part) for part in field[several] if part.get("type") != "null"]
            return " or ".join(dict.fromkeys(parts))
    if "const" in field or "enum" in field:
        return ", ".join(f"`{value}`" for value in field.get("enum", [field.get("const")]))
    kind = field.get("type", "any")
    if kind == "array":
        return f"list of {_allowed(field.get('items', {}))}"
    if kind == "object":
        return f"table of {_allowed(field.get('additionalProperties', {}))}"
    words = {
        "minimum": "at least",
        "maximum": "at most",
        "exclusiveMinimum": "above",
        "exclusiveMaximum": "below",
    }
    limits = [f"{text} {field[key]:g}" for key, text in words.items() if key in field]
    return ", ".join([kind, *limits])


def _value(value):
    return "" if value is None or isinstance(value, (dict, list)) else f"`{json.dumps(value)}`"
