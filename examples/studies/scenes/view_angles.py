"""How far test views are from training views: view_angles.py --scenes DIR

Prints, for every test view, the angle between its camera and the nearest training view's, seen from
the median of the scene's points.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import torch
from splatting.scenes import Scene, load_scene
from splatting.stopping import command

from studies.scenes.plan import SCENES


def nearest_angles(scene: Scene) -> list[float]:
    """Angle to the nearest training view of every test view, degrees, from the points' median."""
    middle = scene.points.median(0).values
    train, test = (
        torch.nn.functional.normalize(
            torch.stack([view.camera.position for view in views]) - middle, dim=1
        )
        for views in (scene.train, scene.test)
    )
    cosines = (test @ train.T).max(dim=1).values
    return torch.rad2deg(torch.acos(cosines.clamp(-1.0, 1.0))).tolist()


@command("view_angles")
def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--scenes", type=Path, required=True, metavar="DIR")
    args = parser.parse_args(arguments)
    for name in SCENES:
        scene = load_scene(name if name == "embedded" else args.scenes / name)
        angles = " ".join(f"{angle:.1f}" for angle in sorted(nearest_angles(scene)))
        print(f"{name}: {len(scene.train)} training views; {angles}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
