"""Fit one scene with one arm: python examples/train.py --scene embedded --arm mcmc -o runs/one

A second start with the same folder goes on from the checkpoint of the first.
"""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import get_args

import numpy as np
import torch
from splatting.arms import ARMS, DEFAULT_ARM, find_arm
from splatting.fit import Fit, FitOptions, run
from splatting.gaussians import save_ply
from splatting.scenes import Background, Size, load_scene
from splatting.stopping import command
from splatting.writable import check_folder

SHARED_OPTIONS = (
    *("scene", "size", "background", "points", "iterations"),
    *("init", "sh_degree", "sh_degree_interval", "switch"),
)


def add_fit_options(parser: argparse.ArgumentParser) -> None:
    """Options that train.py and error_vs_time.py share."""
    defaults = FitOptions(iterations=3_000, points=4_000)
    add = parser.add_argument
    add("--scene", default="embedded", metavar="DIR", help="scene folder, or 'embedded'")
    add("--size", default="images_2", choices=get_args(Size), help="folder of the photos")
    add("--background", default="black", choices=get_args(Background), help="behind the scene")
    add("--points", type=int, default=defaults.points, help="the most Gaussians")
    add("--iterations", type=int, default=defaults.iterations, help="length of a training")
    add("--init", default=defaults.init, choices=("sfm", "random"), help="first Gaussians")
    add(
        "--sh-degree", type=int, default=defaults.sh_degree, choices=range(4), help="of the colours"
    )
    add("--sh-degree-interval", type=int, default=defaults.sh_degree_interval, help="iterations")
    add("--switch", type=float, default=defaults.switch, help="where exploitation starts, 0..1")


def fit_options(args: argparse.Namespace, seed: int = 0) -> FitOptions:
    """Of the command line; ValueError where one is outside what is allowed."""
    return FitOptions(
        args.iterations,
        args.points,
        seed,
        args.init,
        args.sh_degree,
        args.switch,
        sh_degree_interval=args.sh_degree_interval,
    )


def recorded_command(
    program: str, parser: argparse.ArgumentParser, args: argparse.Namespace
) -> str:
    """The command for the report: options that differ from their defaults, folders by name."""
    words = ["python", f"examples/{program}"]
    for name, value in vars(args).items():
        if name in ("out", "quiet", "command", "jobs") or value == parser.get_default(name):
            continue
        plain = Path(value).name if name == "scene" else value
        listed = ",".join(map(str, plain)) if isinstance(plain, list) else str(plain)
        words += [f"--{name.replace('_', '-')}", listed]
    return shlex.join(words)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=(__doc__ or "").splitlines()[0],
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add_fit_options(parser)
    arms = "; ".join(f"{arm.name}: {arm.what}" for arm in ARMS.values())
    parser.add_argument("--arm", default=DEFAULT_ARM, choices=ARMS, metavar="ARM", help=arms)
    parser.add_argument("--seed", type=int, default=0, help="of the training")
    parser.add_argument("--mean-nu", type=float, help="for the arm constant")
    parser.add_argument(
        "-o", "--out", type=Path, default=Path("runs/train"), metavar="DIR", help="folder"
    )
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    parser.add_argument("--command", help="the command to record in the log")
    return parser


@command("train")
def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    args = _parser().parse_args(arguments)
    torch.set_num_threads(1)
    options = fit_options(args, args.seed)
    check_folder(args.out)
    scene = load_scene(args.scene, args.size, background=args.background)
    fit = Fit(scene, find_arm(args.arm), options, args.mean_nu)
    said = args.command or recorded_command("train.py", _parser(), args)
    about = {"size": args.size, "background": args.background, "command": said}
    metrics = run(fit, args.out, about, quiet=args.quiet)
    save_ply(args.out / "gaussians.ply", fit.gaussians)
    np.save(args.out / "view.npy", fit.image(scene.test[0]).numpy())  # for a gallery
    if not args.quiet:
        print(f"{args.arm}: test PSNR {metrics['psnr']:.2f} dB, SSIM {metrics['ssim']:.4f}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
