"""Configuration of the documentation. `make docs` builds it into docs/_build/html."""

from __future__ import annotations

import re

from docutils import nodes
from docutils.utils.math import latex2mathml
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator

import sb3_flowpolicy

project = "sb3_flowpolicy"
version = release = sb3_flowpolicy.__version__
language = "en"
exclude_patterns = ["_build", "images/README.md"]

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3

default_role = "code"
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings say it, with shapes and units
autodoc_class_signature = "mixed"
napoleon_use_ivar = True
napoleon_use_rtype = False

html_theme = "furo"
html_title = "sb3_flowpolicy"
html_copy_source = False
html_show_copyright = False
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_math_renderer = "mathml"  # drawn by the browser: MathJax would be fetched from the network


def mathml(equation: str, as_block: bool = False) -> str:
    """Translate LaTeX, without the two commands that docutils does not know."""
    known = re.sub(r"\\big(?![a-z])", "", re.sub(r"\\dots(?![a-z])", r"\\ldots", equation))
    return latex2mathml.tex2mathml(known, as_block)


def visit_math(translator: HTML5Translator, node: nodes.math) -> None:
    """Write an inline equation as MathML."""
    translator.body.append(mathml(node.astext()))
    raise nodes.SkipNode


def visit_math_block(translator: HTML5Translator, node: nodes.math_block) -> None:
    """Write a displayed equation as MathML."""
    translator.body.append(f'<div class="math">{mathml(node.astext(), as_block=True)}</div>')
    raise nodes.SkipNode


def adapt_docstring(
    app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]
) -> None:
    """Keep the summary of a Markdown docstring: Gymnasium's have pages of their own."""
    if any(line.startswith("## ") for line in lines):
        lines[1:] = []
    # Bars are absolute values, not substitutions.
    lines[:] = [re.sub(r"\|(\w+)\|", r"\\|\1\\|", line) for line in lines]


def setup(app: Sphinx) -> None:
    """Register the equations and the docstrings of environments."""
    app.add_html_math_renderer("mathml", (visit_math, None), (visit_math_block, None))
    app.connect("autodoc-process-docstring", adapt_docstring)
