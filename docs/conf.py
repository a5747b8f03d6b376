"""Configuration of the documentation's site: ``make docs``."""

import sys
from importlib.metadata import version as version_of
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "docs" / "extensions"), str(ROOT)]

project = "cnfp_torchrl"
author = "the cnfp_torchrl authors"
copyright = author
release = version_of("cnfp_torchrl")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    # In docs/extensions.
    "api",
    "mathml",
    "names",
    "offline",
    "pages",
]

# Pages are read from the repository's root, so that a link from one file to another leads to the
# same place here and where the repository is browsed.
root_doc = "README"
include_patterns = ["README.md", "docs/**", "experiments/**.md"]
SOURCES = {"README.md", "docs", "experiments"}
exclude_patterns = [each.name for each in ROOT.iterdir() if each.name not in SOURCES]
exclude_patterns += ["docs/_build", "docs/_templates"]
templates_path = ["_templates"]
html_theme = "furo"
html_title = "cnfp_torchrl"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_additional_pages = {"index": "redirect.html"}
html_copy_source = False
html_show_sphinx = False
html_math_renderer = "mathml"

# Every reference leads somewhere: `make docs` turns what is found here into errors.
nitpicky = True
# It stands in type stubs alone.
nitpick_ignore = [("py:class", "DataclassInstance")]
default_role = "py:obj"
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3

napoleon_numpy_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True
# An override without a docstring says nothing that its base class does not say.
autodoc_inherit_docstrings = False
# Pages are written by docs/extensions/api.py.
autosummary_generate = False
# `view=NOTHING`, not what the object looks like.
autodoc_preserve_defaults = True
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88
