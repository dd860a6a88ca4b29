"""The README's picture: python examples/studies/scenes/front_picture.py

That of `quickstart.py` from longer trainings; its numbers go into docs/results/front.json.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
from collections.abc import Sequence
from datetime import date
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import torch
from quickstart import draw, train
from splatting.fit import FitOptions
from splatting.scenes import load_scene

FOLDER = Path(__file__).resolve().parents[3] / "docs" / "results"
EVERY = 50  # iterations between two looks, which the clock does not count


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--iterations", type=int, default=1500, help="of each training")
    parser.add_argument("--out", type=Path, default=FOLDER / "front.png", metavar="PNG")
    args = parser.parse_args(arguments)
    scene, options = load_scene("embedded"), FitOptions(args.iterations)
    stock, ours = trainings = train(scene, options, max(args.iterations // EVERY, 1))
    seconds = draw(scene, trainings, args.out)
    reached = next(s for s, p in zip(ours.seconds, ours.psnr, strict=True) if p >= stock.psnr[-1])
    record = {
        "command": "python examples/studies/scenes/front_picture.py",
        "date": f"{date.today()}",
        "machine": f"{platform.system()} {platform.machine()}, one thread, "
        f"torch {torch.__version__}",
        "iterations": args.iterations,
        "points": options.points,
        "pictures_after_seconds": round(seconds, 2),
        "seconds_to_stock_psnr": round(reached, 2),
        "curves": {
            training.name: {
                "seconds": [round(s, 3) for s in training.seconds],
                "psnr": [round(p, 3) for p in training.psnr],
            }
            for training in trainings
        },
    }
    args.out.with_suffix(".json").write_text(json.dumps(record) + "\n", encoding="utf-8")
    print(args.out)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
