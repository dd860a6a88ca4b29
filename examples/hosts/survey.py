"""Which trainers `hosts diff` edits, and what ran: makes docs/hosts/survey.md.

    OPT3DGS_TRAINERS=DIR OPT3DGS_RECORD=1 python -m pytest -m hosts tests/hosts
    python examples/hosts/survey.py --trainers DIR --write

DIR has a folder for each repository. The first command trains, most of an hour of a core, and puts
what came of it into survey.json beside the page; the second needs a few seconds.
"""

from __future__ import annotations

import argparse
import datetime
import json
import platform
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torch
from hosts.trials import (
    ITERATIONS,
    TRIALS,
    Done,
    Outcome,
    Trial,
    commit_of,
    parts_of,
)

from opt3dgs_optim import __version__
from opt3dgs_optim.hosts import diff

PAGE = Path(__file__).resolve().parents[2] / "docs" / "hosts" / "survey.md"
TRAINED = PAGE.with_suffix(".json")
LONG = PAGE.with_name("long_runs.json")
SCRIPTS = ("*train*.py", "prune_finetune.py")
OTHERS = re.compile(
    r"(^|/)(submodules|tests?|scripts|docs|utils?|preprocess|ext|internal|Tracking[^/]*)/"
)
MORE = (
    *("sugar_trainers/*.py", "nerfstudio/engine/trainer.py", "internal/gaussian_splatting.py"),
    "fvdb_reality_capture/training/scene_optimization_runner.py",
)
FIGURE = re.compile(r"-?[\d.]+ dB|\bruns\b")
GROUPS = re.compile(r" \(all: [^)]*\)")  # the names of an optimizer's groups: long
STOPS = re.compile(r"(?<=stops: )(\w+):.*")  # what an exception says after its name
PAGE_TEXT = """# Which trainers were tried

`python examples/hosts/survey.py --trainers DIR --write` makes this page \
(opt3dgs_optim {version}, {today}).

In these tables *stock* is a trainer as its authors have published it, and *edited* is the same \
trainer with the lines, the method or the plugin of this package.

## 3,000 iterations, stock and edited

{long}

## What ran

{iterations} iterations of the real script on a CPU through `on_cpu.py`, \
on {scene}, as published and with the lines of this package. So short a run shows that a \
trainer runs, saves and resumes with the lines; how good it gets is not to be read from it. \
Parts that were on in the end: {parts}. {date}, torch {torch}, {machine}.

| trainer and options | commit | lines of `diff` | stock | edited | saved | resumed | \
what is different |
|---|---|---|---|---|---|---|---|
{ran}
{counts[0]} of the {counts[1]} trials in `examples/hosts/trials.py` have \
been run for this table; {counts[2]} of them left a checkpoint. \
Resumed: the edited trainer, from its own checkpoint and from the stock one's; \
gsplat's scripts evaluate a checkpoint and do not go on from one \
([lines that do](gsplat.md#save-and-resume)). `tests/hosts/test_each_part.py` trains \
gsplat 1.5.3 with these lines, and 3dgs-mcmc, with each part alone, and goes on from what they save.

3DGRUT and fVDB reality capture render with CUDA kernels of their own: \
`examples/hosts/without_renderer.py` runs how they make, edit, save and load their optimizers \
([3DGRUT](3dgrut.md), [fVDB](fvdb.md)).

## `hosts diff` over public trainers

{counts[3]} training scripts of {counts[4]} repositories: {counts[5]} are edited \
(each result compiles and defines every name it uses), the others are refused; \
for these the lines to add by hand are printed, or the page that has them is named.

<details markdown><summary>All scripts, with their commits</summary>

| scripts | what `diff` says |
|---|---|
{diffs}
</details>
"""
LONG_TEXT = """\
Each trainer's own script and schedules, these scaled to a tenth, on {scene}; PSNR of the test \
views in dB, one seed, and the Gaussians at the end of the edited training. By \
`examples/hosts/long_runs.py`; {date}, torch {torch}, {machine}.

| trainer and options | commit | stock | edited | difference | parts that were on | Gaussians | \
with `DEFAULTS_ADC` |
|---|---|---:|---:|---:|---|---:|---:|
{rows}
The photos are 160 pixels wide, and the thresholds of clone and split are made for ten times as \
many, so that these trainers clone and split far more than on photos of full size. gsplat 1.5.3 \
never resets the opacities, so that few Gaussians are pruned. There `Annealing` and `Fading` make \
[still more](../results/study/tables.md#without-resets-of-the-opacities), and the views that were \
held out get worse. With averaging alone the training is the unchanged one until its last \
thirtieth."""


@dataclass(frozen=True)
class Script:
    """What `diff` says of one file."""

    trainer: str
    path: str
    commit: str
    edited: bool
    said: str  # notes, or why it is refused
    lines: int


def scripts_of(folder: Path) -> list[Path]:
    """The training scripts of a repository."""
    found = {p for pattern in SCRIPTS for p in folder.rglob(pattern)}
    kept = {p for p in found if not OTHERS.search(str(p.relative_to(folder)))}
    kept |= {p for pattern in MORE for p in folder.glob(pattern)}
    return sorted(p for p in kept if "backward(" in p.read_text(errors="ignore"))


def survey(trainers: Path) -> list[Script]:
    """`diff` over every training script."""
    rows = []
    for folder in sorted(p for p in trainers.iterdir() if p.is_dir()):
        for path in scripts_of(folder):
            name = str(path.relative_to(folder))
            try:
                done = diff(path)
            except ValueError as error:
                rows.append(Script(folder.name, name, commit_of(folder), False, str(error), 0))
                continue
            lines = len(re.findall(r"^\+(?!\+\+)", done.diff, re.M))
            notes = "; ".join(done.notes)
            rows.append(Script(folder.name, name, commit_of(folder), True, notes, lines))
    return rows


# -- trainings -------------------------------------------------------------------------------------


def keep(trial: Trial, trainers: Path, scene: str, got: Outcome) -> None:
    """Put what a trial came to into survey.json, in the place of an earlier one."""
    row: dict[str, Any] = {"name": trial.name, "commit": commit_of(trainers / trial.trainer)}
    row |= {"date": datetime.date.today().isoformat(), "torch": torch.__version__}
    row |= {"stock": _shown(got.stock), "ours": _shown(got.ours)}
    row["parts"] = parts_of(got.ours.output)
    row |= {"checkpoint": "yes" if got.checkpoint else "-", "resume": "-"}
    if got.own and got.theirs:
        row["resume"] = f"own: {_shown(got.own)}; stock's: {_shown(got.theirs)}"
    kept = _kept(json.loads(TRAINED.read_text())["rows"], row, scene)
    TRAINED.write_text(json.dumps(kept, indent=1) + "\n")


def _kept(rows: list[dict[str, Any]], new: dict[str, Any], scene: str) -> dict[str, Any]:
    """The trainings to keep: the new one in the place of an old one."""
    known = [trial.name for trial in TRIALS]
    every = {row["name"]: row for row in rows if row["name"] in known} | {new["name"]: new}
    return {
        "iterations": ITERATIONS,
        "scene": scene,
        "machine": f"{platform.machine()}, Python {platform.python_version()}",
        "rows": sorted(every.values(), key=lambda row: known.index(row["name"])),
    }


def _shown(done: Done) -> str:
    if done.code == 0:
        return f"{done.psnr:.2f} dB" if done.psnr is not None else "runs"
    return f"stops: {done.reason[:90]}"


# -- the page --------------------------------------------------------------------------------------


def page(rows: list[Script], trials: dict[str, Any]) -> str:
    """The page's text."""
    edited = [row for row in rows if row.edited]
    names = {row.trainer for row in rows}
    lines = {(row.trainer, row.path): str(row.lines) for row in edited}
    trained = {row["name"]: row for row in trials["rows"]}
    ran = []
    for trial in TRIALS:
        if row := trained.get(trial.name):
            count = lines.get((trial.trainer, trial.script), trial.lines)
            ran.append(_row(trial.name, row["commit"], count, *_outcome(row), trial.different))
    saved = sum(row["checkpoint"] == "yes" for row in trials["rows"])
    said: dict[str, list[str]] = {}
    for row in rows:
        # A line of a script, which is quoted there, has no meaning in Markdown.
        words = re.sub(r"([\[\]*_`])", r"\\\1", row.said)
        what = words or "nothing" if row.edited else f"**refused**: {words}"
        script = f"`{row.trainer}/{row.path}@{row.commit.split()[0]}`"
        said.setdefault(GROUPS.sub("", what), []).append(script)
    diffs = [_row(" ".join(scripts), what) for what, scripts in said.items()]
    return PAGE_TEXT.format(
        version=__version__,
        today=datetime.date.today().isoformat(),
        **{key: trials[key] for key in ("iterations", "scene", "machine")},
        **{key: _span(trials, key) for key in ("date", "torch")},
        parts=" or ".join(sorted({row["parts"] for row in trials["rows"]} - {"-"})),
        ran="".join(ran),
        long=_long_runs(),
        counts=(len(trials["rows"]), len(TRIALS), saved, len(rows), len(names), len(edited)),
        diffs="".join(diffs),
    )


def _outcome(row: dict[str, Any]) -> list[str]:
    """Whether the stock and the edited trainer ran, saved and resumed, without figures."""
    shown = [STOPS.sub(r"\1", row[key]) for key in ("stock", "ours", "resume")]
    stock, edited, resumed = (FIGURE.sub("ran", text) for text in shown)
    if resumed != "-":
        resumed = "yes" if resumed == "own: ran; stock's: ran" else resumed
    return [stock, edited, row["checkpoint"], resumed]


def _long_runs() -> str:
    """The table of the long runs, or that there are none."""
    rows = json.loads(LONG.read_text(encoding="utf-8"))["rows"] if LONG.is_file() else []
    rows = [row for row in rows if "stock" in row]
    if not rows:
        return "Not run: `python examples/hosts/long_runs.py` makes the table."
    lines = []
    kinds = ("stock", "edited", "DEFAULTS_ADC")
    for row in rows:
        stock, edited = row["stock"]["psnr"], row.get("edited")
        adc = f"{row['DEFAULTS_ADC']['psnr']:.2f}" if "DEFAULTS_ADC" in row else "-"
        shown = ["not run", "-", "-", "-"]
        if edited is not None:
            number = f"{edited['gaussians']:,}" if "gaussians" in edited else "-"
            psnr = edited["psnr"]
            shown = [f"{psnr:.2f}", f"{psnr - stock:+.2f}", edited["parts"], number]
        lines.append(_row(row["name"], row["commit"], f"{stock:.2f}", *shown, adc))
    halves = [{"scene": row["scene"], **row[kind]} for row in rows for kind in kinds if kind in row]
    spans = {key: _span({"rows": halves}, key) for key in ("scene", "date", "torch", "machine")}
    return LONG_TEXT.format(rows="".join(lines), **spans)


def _span(trials: dict[str, Any], key: str) -> str:
    """What the trainings have in common, or the first and the last."""
    seen = sorted({row[key] for row in trials["rows"]})
    return " to ".join(dict.fromkeys([seen[0], seen[-1]])) if seen else "none"


def _row(*cells: str) -> str:
    return "| " + " | ".join(_cell(cell) for cell in cells) + " |\n"


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ").replace("<", "&lt;") or "-"


def main() -> None:
    """Survey, and print or write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trainers", type=Path, required=True, help="a folder of repositories")
    parser.add_argument("--write", action="store_true", help=f"write {PAGE.name}")
    options = parser.parse_args()
    text = page(survey(options.trainers), json.loads(TRAINED.read_text()))
    if options.write:
        PAGE.write_text(text, encoding="utf-8")
    else:
        print(text)


if __name__ == "__main__":
    main()
