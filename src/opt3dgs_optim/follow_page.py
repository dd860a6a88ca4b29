"""The live view's page: one HTML file that needs nothing else, on a desktop or a phone."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from datetime import datetime

from opt3dgs_optim.follow_state import Watched
from opt3dgs_optim.report_style import label_of, look

__all__ = ["page"]

# No request leaves the page: a browser refuses whatever is not in the file itself.
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
STYLE = """
:root { color-scheme: light; }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 1180px; padding: 20px 16px 32px; color: #222; background: #fff;
  font: 15px/1.45 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
header { display: flex; flex-wrap: wrap; align-items: baseline; gap: 4px 16px; }
h1 { font-size: 21px; margin: 0; }
header p, footer { color: #666; font-size: 13px; margin: 0; }
.runs { display: grid; grid-template-columns: repeat(auto-fill, minmax(255px, 1fr)); gap: 12px;
  margin: 16px 0; }
.run { border: 1px solid #ddd; border-left: 4px solid var(--ink); border-radius: 6px;
  padding: 10px 12px; min-width: 0; }
.run h2 { font-size: 15px; margin: 0; overflow-wrap: anywhere; }
.run .path { color: #777; font-size: 12px; margin: 0 0 6px; overflow-wrap: anywhere; }
.state { float: right; font-size: 12px; font-weight: 600; padding: 1px 8px; border-radius: 9px;
  margin-left: 8px; background: #eee; color: #555; }
.running { background: #dff0e6; color: #14633a; } .finished { background: #e3ebf8; color: #1d4a8a; }
.interrupted, .silent, .unreadable { background: #fbe6da; color: #8a3b0c; }
.unreadable ~ .detail { color: #8a3b0c; }
.bar { height: 5px; border-radius: 3px; background: #e8e8e8; margin: 6px 0 8px; overflow: hidden; }
.bar i { display: block; height: 100%; background: var(--ink); }
dl { display: grid; grid-template-columns: auto 1fr; gap: 1px 12px; margin: 0; font-size: 13.5px; }
dt { color: #666; } dd { margin: 0; text-align: right; font-variant-numeric: tabular-nums; }
.detail { margin: 6px 0 0; color: #777; font-size: 13px; overflow-wrap: anywhere; }
img { display: block; width: 100%; height: auto; margin: 8px 0 12px; }
.note { color: #666; padding: 24px 0; }
"""
# Reloads, keeping the place; a page that nobody sees waits.
RELOAD = """
(function () {
  var key = "opt3dgs_optim.live.scroll";
  try { scrollTo(0, +sessionStorage.getItem(key) || 0); } catch (error) {}
  setInterval(function () {
    if (document.hidden) return;
    try { sessionStorage.setItem(key, String(scrollY)); } catch (error) {}
    location.reload();
  }, MILLISECONDS);
})();
"""


def page(
    runs: Sequence[Watched],
    metric: str,
    pictures: tuple[bytes, bytes],
    *,
    every: float | None,
    note: str = "",
) -> str:
    """The whole page.

    Args:
        runs: in the order of the picture's colours.
        metric: shown with each run, if evaluated.
        pictures: PNG for a desktop and for a phone, or b"" each.
        every: seconds between reloads, or None for a page that stays as it is.
        note: instead of a picture.
    """
    now = datetime.now().astimezone().strftime("%Y-%m-%d %H:%M:%S")
    live = "the last state" if every is None else f"reloads every {every:g} s"
    cards = "\n".join(_card(i, run, metric) for i, run in enumerate(runs))
    parts = [
        "<!doctype html>",
        '<html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">',
        "" if every is None else _without_scripts(every),
        f"<title>{html.escape(_title(runs))}</title><style>{STYLE}</style></head><body>",
        f"<header><h1>{html.escape(_title(runs))}</h1><p>{now}, {live}</p></header>",
        f'<section class="runs">{cards}</section>',
        _figure(pictures) or f'<p class="note">{html.escape(note)}</p>',
        f"<footer>{html.escape(_legend(metric))}</footer>",
    ]
    if every is not None:
        parts.append(f"<script>{RELOAD.replace('MILLISECONDS', str(round(every * 1000)))}</script>")
    return "\n".join(part for part in parts if part) + "\n</body></html>\n"


def _without_scripts(every: float) -> str:
    return f'<noscript><meta http-equiv="refresh" content="{max(1, round(every))}"></noscript>'


def _title(runs: Sequence[Watched]) -> str:
    states = [run.state for run in runs]
    counts = [f"{states.count(state)} {state}" for state in dict.fromkeys(states)]
    return f"{len(runs)} {'run' if len(runs) == 1 else 'runs'}: {', '.join(counts)}"


def _legend(metric: str) -> str:
    return (
        f"{label_of(metric)}: dots are evaluations, shown from the first fifth of the run on. "
        "Loss, nu and accepted pairs: means over stretches of steps; the loss jumps where its "
        "pixel term turns from L1 to L2. "
        "Phase: pale while exploring, full while exploiting."
    )


def _figure(pictures: tuple[bytes, bytes]) -> str:
    wide, narrow = (base64.b64encode(picture).decode() for picture in pictures)
    if not wide:
        return ""
    return (
        '<picture><source media="(max-width: 640px)" '
        f'srcset="data:image/png;base64,{narrow}">'
        f'<img alt="error, nu, accepted pairs and phase over time" '
        f'src="data:image/png;base64,{wide}"></picture>'
    )


def _card(index: int, run: Watched, metric: str) -> str:
    rows = "".join(
        f"<dt>{html.escape(name)}</dt><dd>{html.escape(value)}</dd>"
        for name, value in _facts(run, metric)
    )
    parts = [
        f'<article class="run" style="--ink: {look(index)["color"]}">',
        f'<span class="state {run.state}">{run.state}</span>',
        f"<h2>{html.escape(run.label)}</h2>",
        f'<p class="path">{html.escape("/".join(run.path.parts[-3:]))}</p>',
    ]
    if run.total:
        share = min(1.0, run.iteration / run.total)
        parts.append(f'<div class="bar"><i style="width: {share:.1%}"></i></div>')
    parts.append(f"<dl>{rows}</dl>")
    if run.detail:
        parts.append(f'<p class="detail">{html.escape(run.detail)}</p>')
    return "".join([*parts, "</article>"])


def _facts(run: Watched, metric: str) -> list[tuple[str, str]]:
    """What a card says, top to bottom; nothing that the log does not hold."""
    if not run.records:
        return []
    of = f" of {run.total:,}" if run.total else ""
    facts = [("iteration", f"{run.iteration:,}{of}"), ("run time", duration(run.seconds))]
    rate = run.rate
    if rate and run.state == "running":
        facts.append(("iterations/s", f"{rate:.3g}"))
        if run.total and run.total > run.iteration:
            facts.append(("still to go", duration((run.total - run.iteration) / rate)))
    value = run.evaluated(metric)
    if value is not None:
        facts.append((label_of(metric), f"{value:.4g}"))
    if run.phase:
        facts.append(("phase", run.phase))
    for name, shown in (("loss", "loss"), ("nu", "nu"), ("accepted", "accepted pairs")):
        mean = run.present(name)
        if mean is not None:
            facts.append((shown, f"{mean:.1%}" if name == "accepted" else f"{mean:.4g}"))
    skipped = run.present("skipped_rows")
    if skipped:
        facts.append(("skipped rows", f"{skipped:.3g}"))
    if run.state in ("silent", "interrupted"):
        facts.append(("last line", f"{duration(run.quiet)} ago"))
    return facts


def duration(seconds: float) -> str:
    """Text such as "42 s", "3 min 05 s", "2 h 07 min"."""
    whole = round(seconds)
    if whole < 60:
        return f"{seconds:.1f} s" if seconds < 10 else f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
