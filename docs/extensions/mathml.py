"""Formulas as MathML, which browsers draw themselves: without scripts and fonts."""

import re
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.util import logging
from sphinx.writers.html5 import HTML5Translator

LOGGER = logging.getLogger(__name__)
# Commands of LaTeX that the converter does not know.
MISSING = {r"\arg": r"\mathrm{arg}\,"}
BAR = '<mo stretchy="false">&#x0007C;</mo>'


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the renderer ``mathml`` with Sphinx."""
    app.add_html_math_renderer("mathml", (visit_inline, None), (visit_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def visit_inline(self: HTML5Translator, node: nodes.math) -> None:
    """Write a formula in the line."""
    self.body.append(_converted(node, node.astext(), "inline"))
    raise nodes.SkipNode


def visit_block(self: HTML5Translator, node: nodes.math_block) -> None:
    """Write a formula of its own, its paragraphs as lines."""
    # A directive's first line and what follows it are joined by an empty line.
    for formula in filter(None, map(str.strip, node.astext().split("\n\n"))):
        lines = rf"\begin{{aligned}}{formula}\end{{aligned}}" if r"\\" in formula else formula
        self.body.append(f'<div class="math">{_converted(node, lines, "block")}</div>')
    raise nodes.SkipNode


def _converted(node: nodes.Element, formula: str, display: str) -> str:
    for command, instead in MISSING.items():
        formula = re.sub(
            rf"{re.escape(command)}(?![a-zA-Z])", instead.replace("\\", r"\\"), formula
        )
    try:
        converted = convert(formula, display=display)
    except Exception as error:
        LOGGER.warning("formula %r: %s", formula, type(error).__name__, location=node)
        return ""
    if unknown := re.findall(r"(?:\\|&#x0005C;)[a-zA-Z]+", converted):
        LOGGER.warning("formula %r: unknown commands %s", formula, unknown, location=node)
    # Without the space that a browser puts around an operator between two terms.
    return converted.replace(BAR, f'<mo lspace="0" rspace="0"{BAR.removeprefix("<mo")}')
