"""Pages made before Sphinx runs: the gallery from ``examples/``, the reference from the public names."""

import ast
import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

# In the order of the gallery.
EXAMPLES = (
    "first_muscle",
    "own_meshes",
    "choosing_a_kernel",
    "rbf_against_pbd",
    "tunnelling",
    "sliding",
    "sweep",
    "fibres_and_moment_arms",
    "exporting",
)
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
    listed = "\n".join(EXAMPLES)
    (folder / "index.md").write_text(
        "# Gallery\n\nEach page is a script of `examples/`, run when these pages were built; each ends with a check of "
        f"its own result.\n\n```{{toctree}}\n:maxdepth: 1\n\n{listed}\n```\n",
        encoding="utf-8",
    )


def _write_page(root, folder, name):
    script, page = root / "examples" / f"{name}.py", folder / f"{name}.md"
    if page.exists() and page.stat().st_mtime > script.stat().st_mtime:
        return
    pictures = folder / name
    shutil.rmtree(pictures, ignore_errors=True)
    done = subprocess.run(
        [sys.executable, script.name, str(pictures)], cwd=script.parent, capture_output=True, text=True,
        timeout=_TIMEOUT, env=os.environ | {"PYTHONUNBUFFERED": "1"}, check=False,
    )  # fmt: skip
    if done.returncode != 0:
        raise RuntimeError(f"examples/{script.name} failed:\n{done.stderr[-2000:]}")
    source = script.read_text(encoding="utf-8")
    shown = "\n\n".join(
        f"![{path.stem.replace('_', ' ')}]({name}/{path.name})" for path in sorted(pictures.glob("*.png"))
    )
    output = done.stdout.replace(str(pictures), name).replace(str(root), ".").splitlines()[:_LONGEST]
    code = source.split('"""\n', 1)[1].strip()
    parts = [
        ast.get_docstring(ast.parse(source)),
        shown,
        "\n".join(["```text", *output, "```"]),
        f"## The script\n\n```python\n{code}\n```\n",
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
    lines = ["# Python reference", "", "The public names of `rbfmuscle`; each is loaded when first used.", ""]
    for name in sorted(set(package.__all__) - {"__version__"}):
        value = getattr(package, name)
        kind, options = ("autoclass", "   :members:\n") if isinstance(value, type) else ("autofunction", "")
        directive = f".. {kind}:: {value.__module__}.{name}\n{options}"
        lines += [f"## {name}", "", f"```{{eval-rst}}\n{directive}```", ""]
    (folder / "reference.md").write_text("\n".join(lines), encoding="utf-8")


def pages(root):
    """Names of all pages in ``docs/``, without suffix."""
    return sorted(path.stem for path in Path(root / "docs").glob("*.md") if path.stem != "index")
