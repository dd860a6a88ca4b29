"""gsplat without its kernels: `rasterization` for pinhole cameras, relocation, selective Adam."""

from __future__ import annotations

import contextlib
import importlib
from typing import Any

import torch
from cpu_rendering import draw, view_colors
from splatting.camera import Camera
from splatting.metrics import ssim_map
from splatting.relocation import relocated_values
from torch import Tensor

REFUSED = ("packed", "sparse_grad", "covars", "with_ut", "with_eval3d", "distributed")


def install() -> None:
    """Replace what needs a kernel in the gsplat that is importable."""
    import torch.utils.cpp_extension as extension

    extension._find_cuda_home = lambda: None  # type: ignore[assignment]  # builds nothing
    gsplat: Any = importlib.import_module("gsplat")
    rendering: Any = importlib.import_module("gsplat.rendering")
    ops: Any = importlib.import_module("gsplat.strategy.ops")
    torch_impl: Any = importlib.import_module("gsplat.cuda._torch_impl")
    one_radius = getattr(gsplat, "__version__", "9").startswith("1.4")

    def rasterization(*args: Any, **kwargs: Any) -> Any:
        return rasterize(*args, one_radius=one_radius, **kwargs)

    gsplat.rasterization = rendering.rasterization = rasterization
    ops.compute_relocation = relocation
    ops.quat_scale_to_covar_preci = torch_impl._quat_scale_to_covar_preci
    with contextlib.suppress(ImportError):  # gsplat before 1.5 has none
        selective: Any = importlib.import_module("gsplat.optimizers.selective_adam")
        selective.adam = masked_adam


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    sh_degree: int | None = None,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    camera_model: str = "pinhole",
    one_radius: bool = False,
    **others: Any,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """gsplat.rasterization for pinhole cameras, not packed; see there for the arguments."""
    wrong = [name for name in REFUSED if others.get(name)]
    if camera_model != "pinhole" or wrong:
        raise ValueError(f"rasterization on a CPU: {camera_model!r}, {wrong}: not drawn here")
    moved = torch.zeros(len(viewmats), len(means), 2, requires_grad=True)
    drawn = []
    for at, K in enumerate(Ks.detach()):
        lens = (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
        view = Camera(viewmats[at], *lens, width, height)
        shown = colors if colors.dim() == 2 or sh_degree is not None else colors[at]
        if sh_degree is not None:
            shown = view_colors(means, colors.float(), sh_degree, view)
        background = None if backgrounds is None else backgrounds[at]
        drawn.append(draw(means, quats, scales, opacities, shown, view, background, moved[at]))
    images = torch.stack([each.image for each in drawn])
    alphas = torch.stack([each.alpha[..., None] for each in drawn])
    radii = torch.stack([each.radii for each in drawn]).int()
    means2d = torch.stack([each.means2d for each in drawn]).requires_grad_(moved.requires_grad)

    def arrived(grad: Tensor) -> None:  # strategies read the gradient of the projected means
        means2d.grad = grad if means2d.grad is None else means2d.grad + grad
        if others.get("absgrad"):  # smaller than the sum of the pixels' absolute values
            setattr(means2d, "absgrad", means2d.grad.abs())  # noqa: B010

    moved.register_hook(arrived)
    info = {
        **{"means2d": means2d, "radii": radii if one_radius else torch.stack([radii, radii], -1)},
        **{"width": width, "height": height, "n_cameras": len(viewmats), "gaussian_ids": None},
    }
    if "D" in render_mode:  # the evaluation draws depths, which nothing reads here
        images = torch.cat([images, torch.zeros_like(alphas)], -1)
    return images, alphas, info


def relocation(
    opacities: Tensor,
    scales: Tensor,
    ratios: Tensor,
    binoms: Tensor,
    n_max: int = 51,
    min_opacity: float = 0.0,
) -> tuple[Tensor, Tensor]:
    """Opacities and scales of relocated Gaussians; gsplat's, 3dgs-mcmc's and 3DGRUT's kernel."""
    new_opacities, new_scales = relocated_values(
        opacities.flatten(), scales, ratios.flatten(), min_opacity
    )
    return new_opacities.reshape(opacities.shape), new_scales


@torch.no_grad()
def masked_adam(
    param: Tensor,
    grad: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    visible: Tensor,
    lr: float,
    beta1: float,
    beta2: float,
    eps: float,
) -> None:
    """Adam without bias correction on the visible rows: gsplat's and INRIA's sparse kernel."""
    rows = visible.reshape(-1).bool()
    g = grad[rows]
    first = beta1 * exp_avg[rows] + (1 - beta1) * g
    second = beta2 * exp_avg_sq[rows] + (1 - beta2) * g.square()
    exp_avg[rows], exp_avg_sq[rows] = first, second
    param[rows] -= lr * first / (second.sqrt() + eps)


def fused_ssim(img1: Tensor, img2: Tensor, padding: str = "same", train: bool = True) -> Tensor:
    """SSIM of images [B, 3, H, W] with a window of 11; `valid` leaves the border out."""
    border = 5 if padding == "valid" else 0
    a, b = (images.permute(0, 2, 3, 1) for images in (img1, img2))
    height, width = a.shape[1:3]
    inner = ssim_map(a, b)[:, border : height - border, border : width - border]
    return inner.mean() if inner.numel() else img1.sum()
