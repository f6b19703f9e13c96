"""Sphinx configuration; built by `make docs`, with warnings as errors."""

import os
import re
from importlib.metadata import version as installed_version

project = "ssmppl"
author = "The ssmppl developers"
copyright = "the ssmppl developers"
version = release = installed_version("ssmppl")

extensions = [
    "myst_nb",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
    "sphinx-mathjax-offline",  # the pages ask nobody else for anything
]
exclude_patterns = ["_build", "**.ipynb_checkpoints"]

# Under another backend than the notebooks' own their figures would not be on the pages.
os.environ.pop("MPLBACKEND", None)
# What is told of compilation would leave empty outputs on the pages.
os.environ["SSMPPL_PROGRESS"] = "lines"

# Notebooks are Markdown files. All are run anew for every build; an error in one fails it.
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 900
nb_execution_show_tb = True
nb_merge_streams = True
myst_enable_extensions = ["amsmath", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3

default_role = (
    "py:obj"  # what docstrings put between single backticks: a link if it is a public name
)
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings give shapes, which say more
autosummary_generate = True
numpydoc_class_members_toctree = False
numpydoc_show_class_members = False
templates_path = ["_templates"]
# Of what is on the pages: a summary, every parameter in its order with a description, and what is
# returned. A docstring that lacks one of these fails the build.
numpydoc_validation_checks = {
    "GL05", "GL06", "GL07", "GL08", "GL09", "GL10", "SS01", "SS02", "SS03", "SS04",
    "PR01", "PR02", "PR03", "PR07", "PR10", "RT01", "RT03", "YD01",
}  # fmt: skip
# What users catch or are handed, and do not make themselves: no parameters.
numpydoc_validation_exclude = {r"Error$", r"\.UnsupportedOperation$", r"\.Plan$", r"\.Program$",
                               r"\.DeclaredDistribution$", r"\.Generator$"}  # fmt: skip

nb_code_prompt_show = "Show the code"
nb_code_prompt_hide = "Hide the code"

# `make linkcheck` asks other sites; some are slow, some turn programs away.
linkcheck_timeout = 20
linkcheck_retries = 2
linkcheck_workers = 4
linkcheck_anchors = False
linkcheck_ignore = [r"https://doi\.org/", r"http://(127\.0\.0\.1|localhost)"]

html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["ssmppl.css"]
html_domain_indices = False
html_title = f"ssmppl {release}"


def spread_items(app, what, name, obj, options, lines):
    """Turn `name : text`, as docstrings here have it, into numpydoc's name above indented text."""
    out, section = [], ""
    for number, line in enumerate(lines):
        if line and set(line) == {"-"}:
            section = lines[number - 1]
        item = re.match(r"([\w*][\w*, ]*) : (.+)", line) if section else None
        if number + 1 < len(lines) and re.fullmatch("-{3,}", lines[number + 1]):
            section = ""
        if item and section in ("Parameters", "Returns", "Raises", "Attributes"):
            out += [item[1], "    " + item[2]]
        else:
            out.append(line)
    lines[:] = out


def setup(app):
    app.connect("autodoc-process-docstring", spread_items, priority=100)  # before numpydoc
    # Pages are read, and their notebooks run, side by side: the extension that copies MathJax keeps
    # nothing while they are read, and does not say so.
    app.extensions["sphinx-mathjax-offline"].parallel_read_safe = True
