"""A capture of thousands of photos, simulated: is what a photo does not see destroyed?

    python examples/studies/large_capture.py              (trains, and writes all of the below)
    python examples/studies/large_capture.py --redraw     (from the trainings that there are)

A field of toys, photographed from low above by cameras at random places: a photo sees a thirtieth
of the scene, whole, where the study's trainings cut photos up. 3DGS-MCMC with torch's Adam (`mcmc`)
is trained beside the package's defaults, and both of them once more with `OutOfView` added or left
out, with two seeds each. One thread, a quarter of an hour; the same command goes on where it was
stopped.

Writes `docs/results/capture/capture.json` and `capture.png`, and the table of docs/evidence.md.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import matplotlib.pyplot as plt
import numpy as np
import torch
from splatting import patterns
from splatting.arms import Arm
from splatting.camera import Camera
from splatting.embedded import photo, sparse_points
from splatting.fit import Fit, FitOptions, run
from splatting.metrics import psnr
from splatting.raycast import Array, Box, Ground, Solid, Sphere
from splatting.scenes import Scene, View, scene_extent
from splatting.stopping import command

from opt3dgs_optim import DEFAULTS, OutOfView, Part
from opt3dgs_optim.runs import read_run
from studies.pages import filled, table

ROOT = Path(__file__).resolve().parents[2]
OUT = ROOT / "docs" / "results" / "capture"
PAGE = ROOT / "docs" / "evidence.md"
MARK = "<!-- capture:{} -->"
PLOTS, PLOT = (8, 5), 2.5  # toys along x and y, and the world units between two
SIZE = (64, 48)  # pixels of a photo
NEAR = 6.0  # world units around a camera's target, beyond which no toy is in its photo
HELD_OUT = 48
LOOKS = 40  # photos that the share of visible Gaussians is taken over
LARGEST_SHARE = 0.06  # of the sparse points in a photo, in the mean


def parts(*without: type[Part], also: Sequence[Part] = ()) -> Any:
    """The defaults but for some, and others."""
    kept = [part for part in DEFAULTS if not isinstance(part, without)]
    return lambda _iterations, _nu: [*kept, *also]


ARMS = (
    Arm("mcmc", "3DGS-MCMC as published"),
    Arm("out-of-view", "3DGS-MCMC with `OutOfView`", lambda _iterations, _nu: [OutOfView()]),
    Arm("defaults-without", "the defaults without `OutOfView`", parts(OutOfView)),
    Arm("defaults", "the defaults", parts()),
)
TITLES = {
    "mcmc": "3DGS-MCMC",
    "out-of-view": "3DGS-MCMC with OutOfView",
    "defaults-without": "defaults without OutOfView",
    "defaults": "defaults",
}


def field(rough: patterns.Noise, fine: patterns.Noise, points: Array, _normals: Array) -> Array:
    """Ground of plots of many colours, so that no two places look alike."""
    x, y = points[0], points[1]
    column, row = np.floor(x / PLOT), np.floor(y / PLOT)
    hue = np.stack([rough(column * a + 0.1, row * b + 0.3) for a, b in ((0.37, 0.61),) * 3])
    hue += np.stack([0.25 * np.sin(column * k + 2.1 * row * k) for k in (1.0, 1.7, 2.9)])
    grain = fine(x * 0.21, y * 0.21)
    return np.clip(0.15 + 0.6 * hue + 0.5 * (grain - 0.5), 0, 1).astype(np.float32)


def toys(rng: np.random.Generator) -> tuple[list[Solid], list[Sphere | Box]]:
    """Ground and sky, and a toy on every plot."""
    rough, fine = patterns.Noise(rng, falloff=1.5), patterns.Noise(rng, falloff=0.9)
    width, depth = (count * PLOT for count in PLOTS)
    kinds = ("ball", "checker", "planet", "marble", "bricks", "planks", "gift")
    made: list[Sphere | Box] = []
    for column in range(PLOTS[0]):
        for row in range(PLOTS[1]):
            x, y = PLOT * (np.array([column, row]) + rng.uniform(0.3, 0.7, 2))
            size, yaw = float(rng.uniform(0.35, 0.6)), float(rng.uniform(0, np.pi))
            kind = kinds[(column + 3 * row) % len(kinds)]
            ball = {
                "ball": patterns.beach_ball,
                "checker": patterns.checker_ball,
                "planet": partial(patterns.planet, rough),
                "marble": partial(patterns.marble, rough),
            }.get(kind)
            if ball is not None:
                made.append(Sphere((x, y, size), size, ball))
                continue
            box = {
                "bricks": partial(patterns.bricks, rough),
                "planks": partial(patterns.planks, fine),
                "gift": partial(patterns.gift, size),
            }[kind]
            made.append(Box((x, y, size), (size, size, size), yaw, box))
    sky = Sphere((width / 2, depth / 2, 0.0), 60.0, partial(patterns.sky, rough), is_sky=True)
    return [sky, Ground(partial(field, rough, fine))], made


def camera_at(position: Array, target: Array, focal: float, size: tuple[int, int]) -> Camera:
    """A camera there that looks at the target, its upper side towards +z or, from above, +y."""
    forward = (target - position) / np.linalg.norm(target - position)
    up = np.array([0.0, 0.0, 1.0]) if abs(forward[2]) < 0.999 else np.array([0.0, 1.0, 0.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack((right, np.cross(forward, right), forward))
    viewmat[:3, 3] = -viewmat[:3, :3] @ position
    width, height = size
    return Camera(
        torch.from_numpy(viewmat).float(), focal, focal, width / 2, height / 2, width, height
    )


def make_scene(photos: int, points: int, seed: int = 0) -> tuple[Scene, View]:
    """The field, `photos` views to train on and some to judge by; and the whole from above."""
    rng = np.random.default_rng(seed)
    ground, made = toys(rng)
    width, depth = (count * PLOT for count in PLOTS)
    views, seen = [], []
    for index in range(photos + HELD_OUT):
        target = np.array([rng.uniform(0.5, width - 0.5), rng.uniform(0.5, depth - 0.5), 0.3])
        turn, pitch = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(45, 65))
        outward = [np.cos(turn) * np.cos(pitch), np.sin(turn) * np.cos(pitch), np.sin(pitch)]
        position = target + rng.uniform(2.8, 3.6) * np.array(outward)
        near = [toy for toy in made if np.linalg.norm(np.array(toy.center) - target) < NEAR]
        camera, solids = camera_at(position, target, 1.2 * SIZE[0], SIZE), [*ground, *near]
        views.append(View(f"photo_{index:04d}", camera, photo(solids, camera, 3)))
        seen.append((solids, camera))
    train, test = views[:photos], views[photos:]
    sparse, colors = sparse_points(seen[:photos], points, rng)
    extent = scene_extent([view.camera for view in train])
    middle = np.array([width / 2, depth / 2, 0.0])
    above = camera_at(middle + np.array([0.0, 0.0, 40.0]), middle, 40 * 360 / width, (360, 225))
    whole = View("from above", above, photo([*ground, *made], above, 2))
    return Scene("large", train, test, sparse, colors, extent), whole


def visible_share(points: torch.Tensor, views: Sequence[View]) -> float:
    """Mean share of the points [N, 3] that lie in a view's picture."""
    shares = []
    for view in views:
        camera = view.camera
        x, y, z = (points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]).unbind(1)
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        inside = (z > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        shares.append(float(inside.float().mean()))
    return float(np.mean(shares))


def share_seen(scene: Scene) -> float:
    """Mean share of the sparse points that a photo sees; ValueError where it is large."""
    share = visible_share(scene.points, scene.train[:: max(len(scene.train) // LOOKS, 1)])
    if share > LARGEST_SHARE:
        raise ValueError(f"a photo sees {share:.1%} of the points: not a large capture")
    return share


def train_all(args: argparse.Namespace, seed: int, scene: Scene, whole: View) -> None:
    """Train every arm with one seed to its end and leave its renders."""
    for arm in ARMS:
        place = place_of(args.runs, seed, arm)
        place.mkdir(parents=True, exist_ok=True)
        options = FitOptions(args.iterations, args.points, seed, evaluations=10)
        fit = Fit(scene, arm, options)
        start = time.process_time()
        run(fit, place, quiet=False)
        if not (place / "renders.npz").exists():
            images = [fit.image(view).numpy() for view in (whole, *scene.test)]
            alive = float((torch.sigmoid(fit.gaussians["opacities"]) > 0.005).float().mean())
            np.savez_compressed(place / "renders.npz", *(np.uint8(255 * i) for i in images))
            about = {
                "relocated": fit.relocated,
                "alive": round(alive, 4),
                "visible_share": round(visible_share(fit.gaussians["means"], scene.test), 4),
                "cpu_seconds": round(time.process_time() - start, 1),
            }
            (place / "about.json").write_text(json.dumps(about), encoding="utf-8")


def place_of(runs: Path, seed: int, arm: Arm) -> Path:
    """The folder of one training."""
    return runs / f"seed-{seed}" / arm.name


def photo_psnr(scene: Scene, place: Path) -> np.ndarray:
    """PSNR of every held-out photo, dB, of a training's last renders."""
    images = np.load(place / "renders.npz")
    made = [torch.from_numpy(images[name]).float() / 255 for name in images.files[1:]]
    pairs = zip(made, scene.test, strict=True)
    return np.array([float(psnr(render, view.image)) for render, view in pairs])


def gather(args: argparse.Namespace, scene: Scene, share: float) -> dict[str, Any]:
    """What the trainings have left; `share` is that of the points that a photo sees."""
    arms = {
        arm.name: {
            "what": arm.what,
            "seeds": [of_one(scene, place_of(args.runs, seed, arm)) for seed in range(args.seeds)],
        }
        for arm in ARMS
    }
    return {
        "command": "python examples/studies/large_capture.py",
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "machine": f"{platform.system()} {platform.machine()}, one thread, "
        f"torch {torch.__version__}",
        "photos": args.photos,
        "pixels": list(SIZE),
        "points": args.points,
        "iterations": args.iterations,
        "share": round(share, 4),
        "arms": arms,
    }


def of_one(scene: Scene, place: Path) -> dict[str, Any]:
    """What one training has left: counts, curves, and the PSNR of the worst tenth of the photos."""
    each = np.sort(photo_psnr(scene, place))
    curve = {
        name: [round(float(value), 4) for value in values]
        for name, values in read_run(place / "log.jsonl").evaluations.items()
        if name in ("iteration", "psnr", "ssim")
    }
    worst = round(float(each[: max(len(each) // 10, 1)].mean()), 4)
    about = json.loads((place / "about.json").read_text(encoding="utf-8"))
    return {**about, **curve, "psnr_of_worst_tenth": worst}


def texts(result: dict[str, Any]) -> dict[str, str]:
    """The pieces of the page."""
    rows = []
    for arm in result["arms"].values():
        seeds = arm["seeds"]
        psnr, ssim = (fmean(seed[key][-1] for seed in seeds) for key in ("psnr", "ssim"))
        rows.append(
            (
                arm["what"],
                f"{psnr:.2f} / {ssim:.3f}",
                ", ".join(f"{seed['psnr'][-1]:.2f}" for seed in seeds),
                f"{fmean(seed['psnr_of_worst_tenth'] for seed in seeds):.2f}",
                f"{fmean(seed['relocated'] for seed in seeds):,.0f}",
            )
        )
    count = len(next(iter(result["arms"].values()))["seeds"])
    about = (
        f"{result['photos']:,} photos of {result['pixels'][0]}x{result['pixels'][1]} pixels, each "
        f"of which sees {result['share']:.1%} of the scene's points in the mean; "
        f"{result['points']:,} Gaussians, {result['iterations']:,} iterations, means over {count} "
        f"seeds; {result['date']}, {result['machine']}, by `{result['command']}`."
    )
    heads = ("training", "held-out PSNR / SSIM", "PSNR of each seed", "PSNR of the worst tenth")
    return {"about": about, "table": table((*heads, "Gaussians relocated"), "lllrr", rows)}


def draw(scene: Scene, whole: View, folder: Path, path: Path) -> None:
    """The scene from above and a held-out photo, beside what each arm made of them.

    Of the first seed, a row each, which a phone can show. The photo is the one at the lower
    quartile of 3DGS-MCMC.
    """
    figure, axes = plt.subplots(1 + len(ARMS), 2, figsize=(6.4, 13.5), layout="constrained")
    order = np.argsort(photo_psnr(scene, place_of(folder, 0, ARMS[0])))
    index = int(order[len(order) // 4])
    shown = [whole, scene.test[index]]
    for axis, view in zip(axes[0], shown, strict=True):
        axis.imshow(view.image.numpy(), interpolation="nearest")
        axis.set_title("the scene, from above" if view is whole else "a held-out photo")
    for row, arm in zip(axes[1:], ARMS, strict=True):
        images = np.load(place_of(folder, 0, arm) / "renders.npz")
        names = images.files[0], images.files[1 + index]
        for axis, name, view in zip(row, names, shown, strict=True):
            made = torch.from_numpy(images[name]).float() / 255
            axis.imshow(images[name], interpolation="nearest")
            quality = f"{float(psnr(made, view.image)):.1f} dB"
            axis.set_title(f"{TITLES[arm.name]}\n{quality}", fontsize=10)
    for axis in axes.flat:
        axis.axis("off")
    figure.savefig(path, dpi=80, pil_kwargs={"optimize": True})
    plt.close(figure)


@command("large_capture")
def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    add = parser.add_argument
    add("--photos", type=int, default=2_000)
    add("--points", type=int, default=20_000, help="the most Gaussians")
    add("--iterations", type=int, default=15_000)
    add("--seeds", type=int, default=2, help="seeds of the trainings; the scene is the same")
    add("--redraw", action="store_true", help="train nothing")
    add("--runs", type=Path, default=Path("runs/large_capture"), metavar="DIR")
    add("-o", "--out", type=Path, default=OUT, metavar="DIR")
    args = parser.parse_args(arguments)
    args.out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    scene, whole = make_scene(args.photos, args.points // 2)
    share = share_seen(scene)
    if not args.redraw:
        for seed in range(args.seeds):
            train_all(args, seed, scene, whole)
    result = gather(args, scene, share)
    (args.out / "capture.json").write_text(json.dumps(result) + "\n", encoding="utf-8")
    draw(scene, whole, args.runs, args.out / "capture.png")
    if args.out == OUT:
        page = filled(PAGE.read_text(encoding="utf-8"), texts(result), MARK)
        PAGE.write_text(page, encoding="utf-8")
    print(args.out / "capture.json", args.out / "capture.png", sep="\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
