"""Held-out views after trainings on cut-up views: unseen_picture.py --runs runs/study

Needs the finished trainings of the stage `unseen` with 30,000 iterations.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import matplotlib.pyplot as plt
import numpy as np
from splatting.stopping import command

from studies.scenes.arms import BASELINE
from studies.scenes.plan import folder_of
from studies.scenes.records import FOLDER
from studies.scenes.training import Spec, scene_of

SCENES = {"bonsai": 10_000, "plush": 4_000}  # and their Gaussians
ARMS = (BASELINE, "faded", "faded+out-of-view+averaged")
PIECES, SEED, VIEW = 9, 0, 4
DPI = 150


@command("unseen_picture")
def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=Path, required=True, metavar="DIR", help="of run.py")
    parser.add_argument("--out", type=Path, default=FOLDER / "unseen.png", metavar="PNG")
    args = parser.parse_args(arguments)
    figure, axes = plt.subplots(
        len(SCENES),
        1 + len(ARMS),
        figsize=(9, 3.3),
        squeeze=False,
        layout="constrained",
    )
    for row, (scene, points) in zip(axes, SCENES.items(), strict=True):
        like = Spec(scene, BASELINE, SEED, 30_000, points, rotated=True, tiled=PIECES)
        for axis, arm in zip(row[1:], ARMS, strict=True):
            folder = folder_of(replace(like, arm=arm), args.runs)
            found = json.loads((folder / "record.json").read_text(encoding="utf-8"))
            images = np.load(folder / "renders.npz")
            axis.imshow(images[images.files[VIEW]], interpolation="nearest")
            axis.set_title(f"{arm}, {found['curve'][-1]['psnr']:.1f} dB", fontsize=8)
        call = json.loads((folder_of(like, args.runs) / "call.json").read_text(encoding="utf-8"))
        view = scene_of(Spec(**call["spec"])).test[VIEW]
        row[0].imshow(view.image.numpy(), interpolation="nearest")
        row[0].set_title(f"{scene}, photo {Path(view.name).name}", fontsize=8)
    for axis in axes.flat:
        axis.axis("off")
    figure.savefig(args.out, dpi=DPI)
    print(args.out)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
