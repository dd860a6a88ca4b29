"""What mkdocs does to these pages besides Markdown; see `hooks` in mkdocs.yml.

Formulas become MathML (no script, no font), `<!-- step costs -->` and `<!-- stability -->` become
tables of the committed JSON, and the cells of tables get their column's name, so that a phone can
show a row as a card. Every page has the version at its foot. A built page that would fetch anything
from the net fails the build.
"""

from __future__ import annotations

import html
import json
import math
import re
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parent
FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.+?)\\[)\]]</\1>', re.S)
TABLE = re.compile(r"<table>\n<thead>.*?</table>", re.S)
COLUMNS = 10  # beyond which cells are narrow
PICTURE = re.compile(r'<img [^>]*\bsrc="([^":]+)"[^>]*>')
FETCHES = (
    re.compile(r"<(?:script|img|iframe|source|video|embed)\b[^>]*\bsrc=[\"']?(?:https?:)?//", re.I),
    re.compile(r"<link\b(?=[^>]*\brel=[\"']?(?:stylesheet|preload|preconnect|icon))"
               r"[^>]*\bhref=[\"']?(?:https?:)?//", re.I),
    re.compile(r"(?:@import\s+|url\()[\"']?(?:https?:)?//", re.I),
)  # fmt: skip


def on_config(config: Any, **_: Any) -> None:
    """Say at the foot of every page which version it describes."""
    from importlib.metadata import version

    config.copyright = f"opt3dgs_optim {version('opt3dgs_optim')}. Apache License 2.0."


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Fill in the tables that are made from committed JSON."""
    markdown = markdown.replace("<!-- step costs -->", step_costs())
    return markdown.replace("<!-- stability -->", stability())


def on_page_content(html: str, **_: Any) -> str:
    """Turn the formulas into MathML, let a picture open by itself."""
    html = FORMULA.sub(lambda m: mathml(m[2], block=m[1] == "div"), html)
    html = TABLE.sub(lambda m: labelled(m[0]), html)
    return PICTURE.sub(r'<a class="picture" href="\1">\g<0></a>', html)


def labelled(table: str) -> str:
    """A table whose cells name their column, for a screen that is too narrow for its header."""
    head, body = table.split("</thead>")
    names = [re.sub(r"<[^>]+>", "", name) for name in re.findall(r"<th[^>]*>(.*?)</th>", head)]

    def row(match: re.Match[str]) -> str:
        left = iter(names)
        cell = r"<td([^>]*)>(.*?)</td>"
        put = r'<td data-label="{}"\1><span>\2</span></td>'
        return re.sub(cell, lambda m: m.expand(put.format(next(left, ""))), match[0], flags=re.S)

    if len(names) > COLUMNS:
        head = head.replace("<table>", "<table data-wide>")
    return f"{head}</thead>{re.sub(r'<tr>.*?</tr>', row, body, flags=re.S)}"


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


STEPS = (  # rows of the benchmark, on the page
    *("six Adams", "defaults", "defaults, a tenth in view", "defaults, last thirtieth"),
    *("defaults, steps of a tenth", "the paper's exploration", "the paper's exploitation"),
)


def step_costs() -> str:
    """What whole steps cost, of every docs/benchmarks/step_*.json, and whether that is the goal."""
    text = []
    for path in sorted((DOCS / "benchmarks").glob("step_*.json")):
        bench = json.loads(path.read_text(encoding="utf-8"))
        sizes = list(bench["results"])
        text += [f"{bench['device']}, torch {bench['torch']}, {bench['date']}:", ""]
        text += ["| ns per point | " + " | ".join(f"{int(n):,} points" for n in sizes) + " |"]
        text += ["|---|" + "---:|" * len(sizes)]
        for step in STEPS:
            rows = [bench["results"][n][step] for n in sizes]
            shown = [f"{row['ns_per_point']:.0f} (x{row['per_adam']:.2f})" for row in rows]
            text.append(f"| {step} | " + " | ".join(shown) + " |")
        text += ["", *goal_table(bench), f"Made by `{bench['command']}`.", ""]
    return "\n".join(text)


def goal_table(bench: dict[str, Any]) -> list[str]:
    """What a step of the defaults costs of what it may cost, by the number of points."""
    found = {n: bench["results"][n]["defaults"]["per_adam"] for n in bench["goals"]}
    text = ["| the defaults, times six Adams | " + " | ".join(f"{int(n):,}" for n in found) + " |"]
    text += ["|---|" + "---:|" * len(found)]
    text += ["| goal | " + " | ".join(f"{goal:.2f}" for goal in bench["goals"].values()) + " |"]
    text += ["| measured | " + " | ".join(f"{ratio:.2f}" for ratio in found.values()) + " |"]
    reached = ["reached" if found[n] <= goal else "missed" for n, goal in bench["goals"].items()]
    return [*text, "| | " + " | ".join(reached) + " |", ""]


PROBLEMS = {
    "Adam": "Adam",
    "LQNAdam": "LQNAdam",
    "two-loop + line search": "the recursion with a line search",
    "LBFGS (torch)": "`torch.optim.LBFGS`",
}


def stability() -> str:
    """Digits reached on the test functions, of docs/results/stability/stability.json."""
    path = DOCS / "results" / "stability" / "stability.json"
    results = json.loads(path.read_text(encoding="utf-8"))
    text = ["| problem | " + " | ".join(PROBLEMS.values()) + " |"]
    text += ["|---|" + "---:|" * len(PROBLEMS)]
    for kind in ("problems", "quadratics"):
        for name, courses in results[kind].items():
            digits = (-math.log10(max(courses[arm][-1][2], 1e-40)) for arm in PROBLEMS)
            cells = ("over 30" if d > 30 else f"{abs(d):.1f}" for d in digits)
            what = name if kind == "problems" else f"quadratic, {name}"
            text.append(f"| {what} | " + " | ".join(cells) + " |")
    about = results["about"]
    text += ["", f"Digits: -log10 of what is left of the error after {about['steps']:,} steps"]
    text += [f"(line searches: up to 150), median of {about['rows']} rows."]
    text += [f"{about['machine']}, {about['date']}."]
    return "\n".join(text)
