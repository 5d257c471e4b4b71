"""Settings of Sphinx; the documentation is built with warnings as errors (`make docs`)."""

import logging
import sys
from importlib.metadata import version as installed
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))  # keys.py, mathml.py, objects.py, gallery.py

logging.getLogger("kros").setLevel(logging.ERROR)  # notebooks say what they find in their outputs

project = "kros"
author = "The kros developers"
copyright = "2026, The kros developers"
release = version = installed("kros")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "keys",
    "mathml",
    "objects",
    "sphinx_gallery.gen_gallery",
]
html_math_renderer = "mathml"
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3
exclude_patterns = ["_build"]

html_theme = "furo"
html_title = f"kros {release}"
html_static_path = ["_static"]
html_css_files = ["kros.css"]

# Notebooks: executed whenever they or their place changed; one that fails fails the build.
sphinx_gallery_conf = {
    "examples_dirs": "../examples/notebooks",
    "gallery_dirs": "notebooks",
    "filename_pattern": r"\.py",
    "image_scrapers": ("matplotlib", "gallery"),
    "ignore_repr_types": "Figure|Text|Legend",
    "within_subsection_order": "ExampleTitleSortKey",
    "abort_on_example_error": True,
    "write_computation_times": False,
    "show_signature": False,
    "download_all_examples": False,
}

# Docstrings: numpydoc, single backticks for code, annotations said once, in the list of parameters.
default_role = "literal"
napoleon_google_docstring = False
napoleon_use_param = False  # types are prose, "ndarray, shape (n_samples, n_y), rad", and no references
napoleon_use_rtype = False
autodoc_typehints = "none"
autodoc_member_order = "bysource"
autodoc_class_signature = "separated"
autodoc_default_options = {
    "members": True,
    "exclude-members": "set_fit_request, set_score_request",
}  # of scikit-learn, without docstrings of ours

# The one-line docstring of a property may begin "Gain: ..."; what has a space in it is no class. Truths are internal.
nitpick_ignore_regex = [("py:class", ".* .*"), ("py:class", r"kros\.plants\..*Truth")]
nitpick_ignore = [("py:exc", "NonFiniteError")]  # internal; users catch DataError, which it is
