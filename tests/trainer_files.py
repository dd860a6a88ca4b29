"""Training scripts with the lines that `hosts diff` goes by, and nothing else of the real ones."""

from __future__ import annotations

import re
from pathlib import Path
from textwrap import indent

import pytest

from opt3dgs_optim.hosts import diff

GSPLAT = """\
import torch
import torch.nn.functional as F
from gsplat.strategy import DefaultStrategy, MCMCStrategy


class Runner:
    def __init__(self, local_rank, world_rank, world_size, cfg):
        self.splats, self.optimizers = create_splats_with_optimizers(
            self.parser,
            batch_size=cfg.batch_size,
        )

    def train(self):
        cfg = self.cfg
        world_size = self.world_size
        max_steps = cfg.max_steps
        init_step = 0
        schedulers = [
            torch.optim.lr_scheduler.ExponentialLR(
                self.optimizers["means"], gamma=0.01 ** (1.0 / max_steps)
            ),
        ]
        pbar = tqdm.tqdm(range(init_step, max_steps))
        for step in pbar:
            try:
                colors, pixels, masks = next(loader)
            except StopIteration:
                loader = iter(trainloader)
                colors, pixels, masks = next(loader)
            l1loss = F.l1_loss(colors, pixels)
            loss = l1loss
            loss.backward()
            for optimizer in self.optimizers.values():
                if cfg.visible_adam:
                    optimizer.step(visibility_mask)
                else:
                    optimizer.step()
            for optimizer in self.pose_optimizers:
                optimizer.step()
            for scheduler in schedulers:
                scheduler.step()
            if isinstance(self.cfg.strategy, DefaultStrategy):
                self.cfg.strategy.step_post_backward(params=self.splats)

    def eval(self, step):
        max_steps = 1
"""
GSPLAT_16 = GSPLAT.replace(
    "            l1loss = F.l1_loss(colors, pixels)\n",
    """\
            if masks is not None:
                l1loss = l1_loss(colors[masks], pixels[masks]).mean()
            else:
                l1loss = l1_loss(colors, pixels).mean()
""",
).replace("params=self.splats", "params=self.splats, scene=self.scene")
GSPLAT_2DGS = (
    GSPLAT.replace("        world_size = self.world_size\n", "")
    .replace("            if isinstance(self.cfg.strategy, DefaultStrategy):\n    ", "")
    .replace("self.cfg.strategy.step", "self.strategy.step")
    .replace(
        "    def train(self)", "        self.strategy = DefaultStrategy()\n\n    def train(self)"
    )
)
INRIA = """\
import torch
from scene import Scene, GaussianModel


def training(dataset, opt, pipe, checkpoint):
    first_iter = 0
    gaussians = GaussianModel(dataset.sh_degree)
    gaussians.training_setup(opt)
    if checkpoint:
        (model_params, first_iter) = torch.load(checkpoint)
        gaussians.restore(model_params, opt)

    bg_color = [1, 1, 1] if dataset.white_background else [0, 0, 0]
    progress_bar = tqdm(range(first_iter, opt.iterations), desc="Training progress")
    first_iter += 1
    for iteration in range(first_iter, opt.iterations + 1):
        image, gt_image = render(gaussians)
        Ll1 = l1_loss(image, gt_image)
        loss = (1.0 - opt.lambda_dssim) * Ll1
        loss.backward()
        with torch.no_grad():
            if iteration < opt.densify_until_iter:
                gaussians.densify_and_prune(opt.densify_grad_threshold, 0.005)
            if iteration < opt.iterations:
                gaussians.exposure_optimizer.step()
                gaussians.optimizer.step()


def training_report(l1_loss):
    l1_test += l1_loss(image, gt_image)
"""
MCMC = INRIA.replace(
    "gaussians.densify_and_prune(opt.densify_grad_threshold, 0.005)",
    "gaussians.relocate_gs(dead_mask=gaussians.get_opacity <= 0.005)",
).replace("                gaussians.exposure_optimizer.step()\n", "")
MINI_SPLATTING = INRIA.replace(
    "            if iteration < opt.iterations:\n",
    """\
            if iteration == simp_iteration1:
                gaussians.training_setup(opt)
            if iteration < opt.iterations:
""",
)
TAMING = INRIA.replace(
    "                gaussians.optimizer.step()\n",
    """\
                gaussians.optimizer.step()
                if iteration % 16 == 0:
                    gaussians.shoptimizer.step()
""",
)
SYNTHETIC = {
    "gsplat": GSPLAT,
    "gsplat 1.6": GSPLAT_16,
    "gsplat 2DGS": GSPLAT_2DGS,
    "inria": INRIA,
    "3dgs-mcmc": MCMC,
    "mini-splatting": MINI_SPLATTING,
    "taming": TAMING,
}


def added(lines: str) -> list[str]:
    """The lines that a diff adds, stripped."""
    return [line[1:].strip() for line in lines.splitlines() if re.match(r"\+(?!\+\+)", line)]


STEP = "gaussians.optimizer.step()\ngaussians.optimizer.zero_grad()"


def short(
    *,
    top: str = "",
    above: str = "",
    over: str = "range(opt.iterations)",
    loss: str = "loss = loss_of()",
    backward: str = "loss.backward()",
    step: str = STEP,
) -> str:
    """A trainer that `running_trainers.run` can run: a function with one loop, then its call.

    Args:
        top: lines above the function.
        above: lines above the loop.
        over: what the loop goes over.
        loss: lines that begin a turn.
        backward: lines after these.
        step: lines that end a turn.
    """
    inside = f"saw(iteration, opt.iterations)\n{loss}\n{backward}\n{step}"
    made = f"gaussians = GaussianModel()\ngaussians.training_setup(opt)\n{above}"
    body = f"{made}\nfor iteration in {over}:\n{indent(inside, ' ' * 4)}"
    head = f"import itertools\nimport torch\nfrom trainer import *\n\n{top}\n\n"
    return f"{head}def training(opt):\n{indent(body, ' ' * 4)}\n\n\ntraining(opt)\n"


def refusal_of(folder: Path, text: str) -> str:
    """What a script is refused with; it names a line."""
    path = folder / "train.py"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"^line \d+: .{20,}") as refused:
        diff(path)
    return str(refused.value)


def lines_of(folder: Path, text: str) -> list[str]:
    """The lines that a script gets, but for the import."""
    path = folder / "train.py"
    path.write_text(text)
    return added(diff(path).diff)[1:]
