"""What mkdocs does to these pages besides Markdown; see `hooks` in mkdocs.yml.

Formulas become MathML (no script, no font). Every page has the version at its foot.
"""

from __future__ import annotations

import html
import re
from typing import Any

FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.+?)\\[)\]]</\1>', re.S)
PICTURE = re.compile(r'<img [^>]*\bsrc="([^":]+)"[^>]*>')


def on_config(config: Any, **_: Any) -> None:
    """Say at the foot of every page which version it describes."""
    from importlib.metadata import version

    config.copyright = f"opt3dgs_optim {version('opt3dgs_optim')}. Apache License 2.0."


def on_page_content(html: str, **_: Any) -> str:
    """Turn the formulas into MathML, let a picture open by itself."""
    html = FORMULA.sub(lambda m: mathml(m[2], block=m[1] == "div"), html)
    return PICTURE.sub(r'<a class="picture" href="\1">\g<0></a>', html)


def mathml(latex: str, *, block: bool) -> str:
    """A formula as MathML, which browsers show by themselves."""
    from latex2mathml.converter import convert

    formula = convert(html.unescape(latex).strip(), display="block" if block else "inline")
    return f'<div class="formula">{formula}</div>' if block else formula
