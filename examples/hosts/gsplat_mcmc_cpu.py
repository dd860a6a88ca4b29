"""A real 3DGS-MCMC training on a CPU: gsplat's strategy, our rasterizer, 64x64, 1,000 points.

    pip install --no-deps gsplat==1.5.3 && pip install jaxtyping rich
    python examples/hosts/gsplat_mcmc_cpu.py --seeds 3

trains each seed with gsplat's own Adam and with Opt3DGS, and prints a table: the stock loss over
all train views, and PSNR. A run takes seconds and shows that the swap works, not what it gains:
300 iterations are a hundredth of a training.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import statistics
import sys
from pathlib import Path
from typing import Any, NamedTuple

import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from hosts.cpu_host import gsplat_modules
from splatting.density import regularisers
from splatting.embedded import embedded_scene
from splatting.gaussians import gaussians_from_points, stock_learning_rates
from splatting.metrics import photometric_loss, psnr
from splatting.rasterizer import render
from splatting.scenes import View

from opt3dgs_optim import PhaseScheduler

SIDE, POINTS, ITERATIONS = 64, 1_000, 300


class Result(NamedTuple):
    """Means over views, after the last iteration."""

    loss: float  # 0.8 L1 + 0.2 (1 - SSIM), of all train views: the stock loss for every arm
    train_psnr: float  # dB
    test_psnr: float  # dB
    points: int


def install(optimizers: Any) -> Any:
    """The documented lines."""
    phases = PhaseScheduler(ITERATIONS)
    return phases, phases.upgrade(optimizers)


ARMS = {"adam": None, "opt3dgs": install}


def gsplat_on_a_cpu() -> Any:
    """gsplat.strategy with its CUDA functions replaced by torch ones."""
    gsplat_modules.install()
    return importlib.import_module("gsplat.strategy")


def crop(view: View) -> View:
    """The middle 64x64 pixels of a 96x72 photo, with the camera that sees them."""
    camera, image = view.camera, view.image
    x, y = (camera.width - SIDE) // 2, (camera.height - SIDE) // 2
    middle = dataclasses.replace(
        camera, cx=camera.cx - x, cy=camera.cy - y, width=SIDE, height=SIDE
    )
    return View(view.name, middle, image[y : y + SIDE, x : x + SIDE].contiguous())


def train(package: Any, seed: int, make: Any = None, iterations: int = ITERATIONS) -> Result:
    """simple_trainer's loop in gsplat 1.5.3's order; `make` returns (phases, optimizers)."""
    torch.manual_seed(seed)
    scene = embedded_scene(seed=0)
    views = [crop(view) for view in scene.train]
    splats: Any = torch.nn.ParameterDict(
        gaussians_from_points(
            scene.points, scene.colors, num_points=POINTS, sh_degree=1, init_scale=1.0
        )
    )
    optimizers: Any = {
        name: torch.optim.Adam([{"params": splats[name], "lr": lr, "name": name}], eps=1e-15)
        for name, lr in stock_learning_rates(scene.extent).items()
    }
    phases = None
    if make is not None:
        phases, optimizers = make(optimizers)
    strategy = package.MCMCStrategy(
        cap_max=1_300, refine_start_iter=25, refine_stop_iter=250, refine_every=25
    )
    strategy.check_sanity(splats, optimizers)
    state = strategy.initialize_state()
    decay = torch.optim.lr_scheduler.ExponentialLR(optimizers["means"], 0.01 ** (1 / iterations))
    for step in range(iterations):
        view = views[int(torch.randint(len(views), ()))]
        image = render(splats, view.camera).image
        pixel_loss = None if phases is None else phases.pixel_loss
        loss = photometric_loss(image, view.image, pixel_loss) + regularisers(splats)
        loss.backward()
        if phases is not None:
            phases.observe(loss)
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        decay.step()
        strategy.step_post_backward(splats, optimizers, state, step, {}, lr=decay.get_last_lr()[0])
    return evaluate(splats, views, [crop(view) for view in scene.test])


@torch.no_grad()
def evaluate(splats: Any, train_views: list[View], test_views: list[View]) -> Result:
    """The stock loss and PSNR of all views."""
    pairs = [(render(splats, view.camera).image, view.image) for view in train_views]
    test = [float(psnr(render(splats, v.camera).image, v.image)) for v in test_views]
    return Result(
        statistics.fmean(float(photometric_loss(*pair)) for pair in pairs),
        statistics.fmean(float(psnr(*pair)) for pair in pairs),
        statistics.fmean(test),
        len(splats["means"]),
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--seeds", type=int, default=3)
    seeds = range(parser.parse_args().seeds)
    package = gsplat_on_a_cpu()
    print("| arm | seed | loss | train PSNR | test PSNR | points |\n|---|---|---|---|---|---|")
    for arm, make in ARMS.items():
        results = [train(package, seed, make) for seed in seeds]
        for seed, r in zip(seeds, results, strict=True):
            shown = f"{r.loss:.5f} | {r.train_psnr:.2f} | {r.test_psnr:.2f} | {r.points}"
            print(f"| {arm} | {seed} | {shown} |")
        mean = statistics.mean(r.loss for r in results)
        print(f"| {arm} | mean | {mean:.5f} | | | |", flush=True)


if __name__ == "__main__":
    main()
