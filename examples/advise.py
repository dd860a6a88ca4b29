"""Which parts pay on a scene: python examples/advise.py --scene DIR

A short pilot on the scene itself: paired trainings (same seed, same start, the last phases branched
off one trunk), each part against its own control. Prints a table, the settings to paste and what
the pilot cannot say; writes advice.json and advice.md. Ctrl-C stops at once; the same command goes
on with the trainings that are missing.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from collections.abc import Sequence
from dataclasses import asdict
from datetime import date
from pathlib import Path
from typing import Any, get_args

from advising.pilots import PEAKS, Pilot, PilotOptions, finished
from advising.verdicts import as_json, as_row, best_peak, caveats, compare, settings, table
from advising.workers import train_all
from splatting.scenes import Size, load_scene
from splatting.stopping import stop_at_once
from train import recorded_command


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    defaults = PilotOptions("embedded")
    add = parser.add_argument
    add("--scene", default=defaults.scene, metavar="DIR", help="scene folder, or 'embedded'")
    add("--size", default=defaults.size, choices=get_args(Size), help="folder of the photos")
    add("--points", type=int, default=defaults.points, help="the most Gaussians")
    add("--iterations", type=int, default=defaults.iterations, help="of each pilot")
    add("--seeds", type=int, default=3)
    add("--init", default=defaults.init, choices=("sfm", "random"), help="first Gaussians")
    add("--sh-degree", type=int, default=defaults.sh_degree, choices=range(4))
    add("--jobs", type=int, default=min(2, os.cpu_count() or 1), help="trainings at a time")
    add("--json", action="store_true", help="print the advice as JSON")
    add("-o", "--out", type=Path, metavar="DIR", help="folder (default: runs/advise-SCENE-SIZE)")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; 0, 2 after one line that says what is wrong, 130 when interrupted."""
    parser = _parser()
    args = parser.parse_args(arguments)
    try:
        for name, least in (("seeds", 2), ("jobs", 1), ("iterations", 8), ("points", 1)):
            if getattr(args, name) < least:
                raise ValueError(f"--{name} {getattr(args, name)}: must be at least {least}")
        scene = load_scene(args.scene, args.size)
        options = PilotOptions(
            args.scene, args.size, args.iterations, args.points, args.init, args.sh_degree
        )
        out = args.out or Path("runs") / f"advise-{scene.name}-{args.size}"
        stop_at_once()
        advice = _advise(options, args.seeds, args.jobs, out)
    except (OSError, ValueError) as error:
        print(f"advise: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted: the same command goes on with what is missing", file=sys.stderr)
        return 130
    advice |= {
        "scene": scene.name,
        "command": recorded_command("advise.py", parser, args),
        "date": date.today().isoformat(),
        "machine": f"{os.cpu_count()} CPU cores, {platform.machine()}",
    }
    advice["options"]["scene"] = scene.name  # no folder of this machine
    text = json.dumps(advice, indent=1)
    (out / "advice.json").write_text(text + "\n", encoding="utf-8")
    (out / "advice.md").write_text(page(advice), encoding="utf-8")
    print(text if args.json else page(advice))
    return 0


def page(advice: dict[str, Any]) -> str:
    """The advice as Markdown."""
    lines = [f"`{advice['command']}` ({advice['machine']}, {advice['date']})", ""]
    lines += [table([as_row(row) for row in advice["rows"]]), ""]
    lines += ["```python", advice["settings"], "```", ""]
    lines += [f"- {said}" for said in caveats(advice)]
    return "\n".join(lines) + "\n"


def _advise(options: PilotOptions, seeds: int, jobs: int, out: Path) -> dict[str, Any]:
    folder = out / "pilots"
    folder.mkdir(parents=True, exist_ok=True)
    every = range(seeds)
    results: dict[Pilot, dict[str, Any]] = {}

    def train(kinds: Sequence[tuple[str, float]], what: str, nu: bool = False) -> None:
        pilots = [Pilot(kind, peak, seed) for seed in every for kind, peak in kinds]
        missing = [p for p in pilots if finished(folder, p, options) is None]
        calls = [(p, options, folder, nus[p.seed] if nu else None) for p in missing]
        train_all(calls, jobs, what)
        for pilot in pilots:
            result = finished(folder, pilot, options)
            assert result is not None
            results[pilot] = result

    def of(kind: str, peak: float) -> list[dict[str, Any]]:
        return [results[Pilot(kind, peak, seed)] for seed in every]

    nus: list[float] = []
    train([("base", peak) for peak in (0.0, *PEAKS)], "1 of 3, annealing")
    scan = {
        peak: compare(f"annealing, peak {peak:g}", "stock rates", of("base", peak), of("base", 0.0))
        for peak in PEAKS
    }
    best = best_peak(scan)
    kinds = ("fading", "pooling", "multiplier", "no noise", "reset", "squared loss", "curvature")
    train([(kind, best) for kind in kinds], "2 of 3, the other parts")
    nus = [result["mean_nu"] for result in of("multiplier", best)]
    train([("constant", best)], "3 of 3, nu's control", nu=True)
    base, reset = of("base", best), of("reset", best)
    last: dict[str, Any] = {"last_phase": True}
    rows = [
        *scan.values(),
        compare("fading", "none", of("fading", best), base),
        compare("pooling", "none", of("pooling", best), base),
        compare("multiplier", "a constant, its mean", of("multiplier", best), of("constant", best)),
        compare("noise", "none", base, of("no noise", best)),
        compare("reset", "moments kept", reset, base, **last),
        compare("squared loss", "L1, reset", of("squared loss", best), reset, **last),
        compare("curvature", "L1, reset", of("curvature", best), reset, **last),
    ]
    return {
        "options": asdict(options),
        "seeds": seeds,
        "views": base[0]["views"],
        "peaks": list(PEAKS),
        "peak": best,
        "mean_nu": [round(nu, 4) for nu in nus],
        "rows": as_json(rows),
        "settings": settings(best, rows),
    }


if __name__ == "__main__":
    raise SystemExit(main())
