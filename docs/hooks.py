"""What mkdocs does to these pages besides Markdown; see `hooks` in mkdocs.yml.

Formulas become MathML (no script, no font), `<!-- step costs -->` becomes a table of the committed
JSON, `<!-- readme: HEADING -->` that section of the README. A built page that would fetch anything
from the net fails the build.
"""

from __future__ import annotations

import html
import json
import re
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parent
README = DOCS.parent / "README.md"
FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.+?)\\[)\]]</\1>', re.S)
PRINTED = '<div class="highlight"><span class="filename">prints</span>'
PICTURE = re.compile(r'<img [^>]*\bsrc="([^":]+)"[^>]*>')
FETCHES = (
    re.compile(r"<(?:script|img|iframe|source|video|embed)\b[^>]*\bsrc=[\"']?(?:https?:)?//", re.I),
    re.compile(r"<link\b(?=[^>]*\brel=[\"']?(?:stylesheet|preload|preconnect|icon))"
               r"[^>]*\bhref=[\"']?(?:https?:)?//", re.I),
    re.compile(r"(?:@import\s+|url\()[\"']?(?:https?:)?//", re.I),
)  # fmt: skip


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Fill in the table and the README's sections."""
    folder = Path(page.file.src_uri).parent
    markdown = markdown.replace("<!-- step costs -->", step_costs())
    up = "../" * len(folder.parts)
    return re.sub(r"<!-- readme: (.+?) -->", lambda m: readme_section(m[1], up), markdown)


def on_page_content(html: str, **_: Any) -> str:
    """Turn the formulas into MathML, mark what is printed, let a picture open by itself."""
    html = FORMULA.sub(lambda m: mathml(m[2], block=m[1] == "div"), html)
    html = html.replace(PRINTED, PRINTED.replace('"highlight"', '"highlight printed"'))
    return PICTURE.sub(r'<a class="picture" href="\1">\g<0></a>', html)


def on_post_build(config: Any, **_: Any) -> None:
    """Fail where a page or style sheet would fetch something from the net."""
    for path in sorted(Path(config["site_dir"]).rglob("*")):
        if path.suffix in (".html", ".css"):
            found = fetched(path.read_text(encoding="utf-8"))
            if found:
                raise SystemExit(f"{path} fetches from the net: {found}")


def fetched(text: str) -> list[str]:
    """What a browser would load from another server when it shows `text`."""
    return [match[0] for pattern in FETCHES for match in pattern.finditer(text)]


def mathml(latex: str, *, block: bool) -> str:
    """A formula as MathML, which browsers show by themselves."""
    from latex2mathml.converter import convert

    formula = convert(html.unescape(latex).strip(), display="block" if block else "inline")
    return f'<div class="formula">{formula}</div>' if block else formula


def readme_section(heading: str, up: str = "") -> str:
    """The README's section of that heading, without it, its links as seen from docs/.

    Args:
        heading: how the heading begins.
        up: the way from the page that includes it to docs/.

    Raises:
        ValueError: no such section, or it links to a file that the site does not have.
    """
    sections = re.split(r"^## ", README.read_text(encoding="utf-8"), flags=re.M)[1:]
    bodies = [body for body in sections if body.startswith(heading)]
    if len(bodies) != 1:
        raise ValueError(f"README.md has {len(bodies)} sections '## {heading}', but one is needed")
    text = bodies[0].partition("\n")[2].strip() + "\n"

    def moved(match: re.Match[str]) -> str:
        label, target = match[1], match[2]
        if target.startswith("docs/"):
            return f"[{label}]({up}{target.removeprefix('docs/')})"
        return match[0] if re.match(r"https?:|#", target) else f"{label} (`{target}`)"

    return re.sub(r"\[([^\]]+)\]\(([^)\s]+)\)", moved, text)


STEPS = ("six Adams", "six Adams + gsplat's noise", "exploration step", "exploitation step")


def step_costs() -> str:
    """What whole steps cost, of every docs/benchmarks/step_*.json."""
    text = []
    for path in sorted((DOCS / "benchmarks").glob("step_*.json")):
        bench = json.loads(path.read_text(encoding="utf-8"))
        sizes = list(bench["results"])
        text += [f"{bench['device']}, torch {bench['torch']}, {bench['date']}:", ""]
        text += ["| ns per point | " + " | ".join(f"{int(n):,} points" for n in sizes) + " |"]
        text += ["|---|" + "---:|" * len(sizes)]
        for step in STEPS:
            cells = [bench["results"][n].get(step) for n in sizes]
            shown = ["–" if c is None else f"{c['ns_per_point']:.0f}" for c in cells]
            text.append(f"| {step} | " + " | ".join(shown) + " |")
        text += ["", f"Made by `{bench['command']}`.", ""]
    return "\n".join(text)
