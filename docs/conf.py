"""Sphinx: `sphinx-build -W -q docs docs/_build`."""

import importlib.metadata

project = "ropetrace"
author = "The ropetrace authors"
release = importlib.metadata.version("ropetrace")
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
html_theme = "furo"
exclude_patterns = ["_build"]
myst_heading_anchors = 3
autodoc_typehints = "none"
napoleon_numpy_docstring = True
