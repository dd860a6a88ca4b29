"""The three lines in a training of 3D Gaussians, whole, in a minute: python examples/quickstart.py

Fits Gaussians to photos of a small scene that it makes itself, once with plain Adam and once with
the same Adam upgraded. Renderer and training loop are here, in plain torch, so that one file shows
where the three lines stand; they are slow and small. So short a training shows more than a long one
keeps: docs/evidence.md has real scenes. It prints the PSNR of photos that were held out, and draws
one of them beside the two renders.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

from opt3dgs_optim import PhaseScheduler

SIZE, VIEWS, HELD_OUT, POINTS, STEPS = 32, 16, 4, 200, 400
RATES = {"means": 1.6e-3, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 2.5e-3}


def train(photos: Tensor, views: Tensor, *, upgraded: bool) -> tuple[dict[str, Tensor], float]:
    """Fit Gaussians to photos [V, H, W, 3] from views [V, 3, 3]; they, and the seconds it took."""
    torch.manual_seed(0)
    splats = {name: each.requires_grad_() for name, each in random_gaussians(POINTS).items()}
    optimizers = {
        name: torch.optim.Adam([{"params": each, "lr": RATES[name], "name": name}], eps=1e-15)
        for name, each in splats.items()
    }
    decay = torch.optim.lr_scheduler.ExponentialLR(optimizers["means"], 0.01 ** (1 / STEPS))

    if upgraded:
        phases = PhaseScheduler(STEPS)
        phases.upgrade(optimizers)

    begin = time.perf_counter()
    name = "with opt3dgs_optim" if upgraded else "stock Adam"
    for i in tqdm(torch.randint(len(photos), (STEPS,)).tolist(), name, disable=None):
        loss = (render(splats, views[i]) - photos[i]).abs().mean()
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        decay.step()
    return splats, time.perf_counter() - begin


def random_gaussians(count: int) -> dict[str, Tensor]:
    """Gaussians in a ball, by gsplat's names; grey, round and half transparent."""
    means = torch.randn(count, 3)
    return {
        "means": means / means.norm(dim=1, keepdim=True) * torch.rand(count, 1).pow(1 / 3),
        "scales": torch.full((count, 3), math.log(0.08)),  # log
        "quats": torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),  # wxyz
        "opacities": torch.zeros(count),  # logit
        "sh0": torch.zeros(count, 3),  # logit of the colour
    }


def render(splats: dict[str, Tensor], view: Tensor) -> Tensor:
    """The image [H, W, 3] that a far camera, turned by `view` [3, 3], sees on white."""
    means = splats["means"] @ view.T
    order = means[:, 2].argsort()  # front to back
    axes = view @ rotations(splats["quats"]) * splats["scales"].exp()[:, None]
    covariance = (axes @ axes.mT)[order, :2, :2] + 0.3 * (2.4 / SIZE) ** 2 * torch.eye(2)
    inverse = torch.linalg.inv(covariance)[..., None, None]  # [N, 2, 2, 1, 1]
    line = (torch.arange(SIZE) + 0.5) / SIZE * 2.4 - 1.2
    dx = line - means[order, 0, None, None]  # [N, 1, W]
    dy = line[:, None] - means[order, 1, None, None]  # [N, H, 1]
    power = inverse[:, 0, 0] * dx**2 + inverse[:, 1, 1] * dy**2 + 2 * dx * (inverse[:, 0, 1] * dy)
    opacities = 0.99 * splats["opacities"][order].sigmoid()
    alpha = opacities[:, None] * (-0.5 * power).exp().flatten(1)  # [N, pixels]
    through = (1 - alpha).cumprod(0)
    weights = alpha * torch.cat([torch.ones_like(alpha[:1]), through[:-1]])
    image = weights.T @ splats["sh0"][order].sigmoid() + through[-1][:, None]
    return image.reshape(SIZE, SIZE, 3)


def rotations(quats: Tensor) -> Tensor:
    """The matrices [N, 3, 3] of quaternions [N, 4], wxyz."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=1).unbind(1)
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(rows, 1).reshape(-1, 3, 3)


def photos_of_a_scene() -> tuple[Tensor, Tensor]:
    """Photos [V, H, W, 3] of a scene of thin and thick Gaussians, and their views [V, 3, 3]."""
    torch.manual_seed(1)
    count = 80
    scene = random_gaussians(count)
    scene["scales"] = torch.log(0.02 + 0.2 * torch.rand(count, 3) ** 2)
    scene["quats"], scene["sh0"] = torch.randn(count, 4), 2 * torch.randn(count, 3)
    scene["opacities"] = torch.full((count,), 3.0)
    views = rotations(torch.randn(VIEWS + HELD_OUT, 4))
    return torch.stack([render(scene, view) for view in views]), views


def draw(images: dict[str, Tensor], path: Path) -> None:
    """Images [H, W, 3] beside each other, with their names."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3 * len(images), 3.3), dpi=150, layout="constrained")
    axes = figure.subplots(1, len(images))
    for axis, (name, image) in zip(axes, images.items(), strict=True):
        axis.imshow(image.clamp(0, 1).numpy(), interpolation="nearest")
        axis.set_title(name)
        axis.axis("off")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, format="png")


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    out = Path("runs/quickstart.png")
    parser.add_argument("-o", "--out", type=Path, default=out, metavar="PNG", help="picture")
    out = parser.parse_args().out
    photos, views = photos_of_a_scene()
    images = {"held-out photo": photos[-1]}
    for upgraded in (False, True):
        splats, seconds = train(photos[:VIEWS], views[:VIEWS], upgraded=upgraded)
        with torch.no_grad():
            seen = torch.stack([render(splats, view) for view in views[VIEWS:]])
        error = (seen.clamp(0, 1) - photos[VIEWS:]).square().mean((1, 2, 3))
        psnr = float((-10 * error.log10()).mean())
        name = "with opt3dgs_optim" if upgraded else "stock Adam"
        print(f"{name}: {psnr:.2f} dB on held-out photos after {STEPS} steps, {seconds:.1f} s")
        images[f"{name}, {psnr:.1f} dB"] = seen[-1]
    draw(images, out)
    print(out)


if __name__ == "__main__":
    main()
