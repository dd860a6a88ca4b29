"""The README's first picture: photo, 3DGS-MCMC, ours, and their PSNR over seconds.

    python examples/studies/scenes/front_picture.py               (trains the embedded scene)
    python examples/studies/scenes/front_picture.py STOCK OURS    (of two trainings of the study)

STOCK and OURS are folders that `run.py` has written: one scene, one setting, one seed, the arm
`mcmc` and another. Their scene's photos must lie where they were trained from. The numbers of the
picture go into a JSON file beside it.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
from collections.abc import Sequence
from datetime import date
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
import torch
from quickstart import Training, draw, train
from splatting.fit import FitOptions
from splatting.metrics import psnr
from splatting.scenes import load_scene
from splatting.stopping import command
from torch import Tensor

from studies.scenes.training import Spec, scene_of

FOLDER = Path(__file__).resolve().parents[3] / "docs" / "results"
ITERATIONS, POINTS, SIZE = 3_000, 4_000, "images_2"  # those of error_vs_time.py
EVERY = 100  # iterations between two looks, which the clock does not count
NAMES = ("3DGS-MCMC", "with opt3dgs_optim")
MINUTES = 300  # seconds from which the axis has minutes


def of_folders(folders: Sequence[Path], view: int) -> tuple[Tensor, list[Training], dict[str, Any]]:
    """Photo, trainings and what they are, of two folders of the study.

    Raises:
        ValueError: they differ by more than the arm, one has not run to its end or has no render of
            that view, or the first is not 3DGS-MCMC's.
    """
    made, specs = [], []
    for name, folder in zip(NAMES, folders, strict=True):
        for file in ("call.json", "record.json", "renders.npz"):
            if not (folder / file).is_file():
                raise ValueError(f"{folder}: has no {file}; a training that has ended is needed")
        record = json.loads((folder / "record.json").read_text(encoding="utf-8"))
        call = json.loads((folder / "call.json").read_text(encoding="utf-8"))
        renders, curve = np.load(folder / "renders.npz"), record["curve"]
        if not 0 <= view < len(renders.files):
            raise ValueError(f"--view {view}: {folder} has {len(renders.files)} renders")
        specs.append(Spec(**call["spec"]))
        image = torch.from_numpy(renders[renders.files[view]]) / 255
        seconds, values = ([row[key] for row in curve] for key in ("seconds", "psnr"))
        made.append(Training(name, seconds, values, [image]))
    first, second = (vars(spec) | {"arm": ""} for spec in specs)
    if first != second or specs[0].arm != "mcmc":
        raise ValueError(f"{folders[0]}, {folders[1]}: mcmc and another arm of one setting needed")
    photo = scene_of(specs[0]).test[view]
    about = {
        **{key: value for key, value in first.items() if key not in ("arm", "scene")},
        "scene": Path(specs[0].scene).name,
        "arms": [spec.arm for spec in specs],
        "view": Path(photo.name).name,
        "command": "python examples/studies/scenes/front_picture.py STOCK OURS",
    }
    return photo.image, made, about


def embedded(iterations: int) -> tuple[Tensor, list[Training], dict[str, Any]]:
    """The same of two trainings on the embedded scene, made now."""
    scene = load_scene("embedded", SIZE)
    made = train(scene, FitOptions(iterations, POINTS), max(iterations // EVERY, 1))
    for training, name in zip(made, NAMES, strict=True):
        training.name = name
    about = {"scene": "embedded", "size": SIZE, "iterations": iterations, "points": POINTS}
    words = "python examples/studies/scenes/front_picture.py"
    words += f" --iterations {iterations}" if iterations != ITERATIONS else ""
    return scene.test[0].image, made, {**about, "seed": 0, "command": words}


@command("front_picture")
def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    add = parser.add_argument
    add("folders", type=Path, nargs="*", metavar="FOLDER", help="STOCK and OURS; none: train")
    add("--view", type=int, default=0, help="of the held-out ones, from 0")
    add("--iterations", type=int, default=ITERATIONS, help="where it trains")
    add("--out", type=Path, default=FOLDER / "front.png", metavar="PNG")
    args = parser.parse_args(arguments)
    if len(args.folders) not in (0, 2):
        raise ValueError(f"front_picture: {len(args.folders)} folders, but two or none are needed")
    made = of_folders(args.folders, args.view) if args.folders else embedded(args.iterations)
    photo, trainings, about = made
    stock, ours = trainings
    draw(photo, trainings, args.out, "min" if stock.seconds[-1] > MINUTES else "s")
    reached = [s for s, p in zip(ours.seconds, ours.psnr, strict=True) if p >= stock.psnr[-1]]
    record = {
        **about,
        "date": f"{date.today()}",
        "machine": f"{platform.system()} {platform.machine()}, one thread, "
        f"torch {torch.__version__}",
        "psnr_of_the_pictures": [round(float(psnr(t.images[-1], photo)), 2) for t in trainings],
        "seconds_to_stock_psnr": round(reached[0], 2) if reached else None,
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
