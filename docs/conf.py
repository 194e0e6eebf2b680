"""Sphinx configuration: ``python -m sphinx -W -b html docs docs/_build``."""

import os
import re
import subprocess
import sys
from pathlib import Path

# Numba's kernels become the plain functions that they were written as, so that autodoc sees them.
os.environ["NUMBA_DISABLE_JIT"] = "1"
# An installed package comes first; the working copy serves where there is none.
sys.path.append(str(Path(__file__).parent.parent))

from sphinx.errors import ExtensionError

import mpmopt

project = "mpmopt"
author = "the mpmopt developers"
copyright = author
version = release = mpmopt.__version__

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.doctest",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
    "myst_parser",
    "numpydoc",
    "sphinx-mathjax-offline",
]
exclude_patterns = ["_build"]
doctest_global_setup = f"import sys; sys.path.append({str(Path(__file__).parent / 'tutorial')!r})"
default_role = "py:obj"
math_eqref_format = "({number})"

autodoc_member_order = "bysource"
autodoc_typehints = "none"
autodoc_default_options = {"members": True}
numpydoc_show_class_members = False

html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["mpmopt.css"]
html_title = f"mpmopt {version}"
html_show_copyright = False
html_show_sphinx = False


def skip_field(app, what, name, member, skip, options):
    """Leave out the fields of named tuples, whose docstring says "Alias for field number"."""
    return True if type(member).__name__ == "_tuplegetter" else skip


def escape_stars_and_bars(app, what, name, member, options, lines):
    """Docstrings are written to be read: |x| is no substitution and *shape no emphasis."""
    for number, line in enumerate(lines):
        if "``" not in line:
            line = line.replace("|", r"\|")
            lines[number] = re.sub(r"(?<!\*)\*(?=\w)(?!.*\*)", r"\*", line)


def make_gallery(app):
    """Run the gallery's cases, if they are not done yet; if one fails, so does the build."""
    script = Path(__file__).parent / "gallery.py"
    compiled = {name: v for name, v in os.environ.items() if name != "NUMBA_DISABLE_JIT"}
    if subprocess.run([sys.executable, str(script)], env=compiled).returncode != 0:
        raise ExtensionError(f"{script} failed: what it says stands above")


def setup(app):
    app.connect("builder-inited", make_gallery)
    app.connect("autodoc-process-docstring", escape_stars_and_bars, priority=900)
    app.connect("autodoc-skip-member", skip_field)
