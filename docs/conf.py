"""Sphinx settings: every page of this folder, the gallery from ``examples/``, the reference of the
public names.

No page asks a server for anything, neither when built nor when read.
"""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(Path(__file__).resolve().parent)]

import gallery  # noqa: E402

import rbfmuscle  # noqa: E402

project = "rbfmuscle"
author = "the rbfmuscle developers"
release = version = rbfmuscle.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_heading_anchors = 3
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"rbfmuscle {version}"
autodoc_member_order = "bysource"
autodoc_typehints = "none"
napoleon_use_rtype = False
# An attribute that is a property too would be described twice.
napoleon_use_ivar = True


def setup(app):
    """Write the pages of the reference and the gallery before Sphinx looks for them."""
    app.connect("autodoc-process-docstring", escape_bars)
    gallery.write_reference(ROOT, rbfmuscle)
    gallery.write_scene_reference(ROOT)
    if (ROOT / "examples").is_dir():
        gallery.write_gallery(ROOT)


def escape_bars(app, what, name, obj, options, lines):
    """A norm |x| in a docstring is no substitution."""
    lines[:] = [line.replace("|", r"\|") for line in lines]
