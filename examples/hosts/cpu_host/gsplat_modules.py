"""gsplat without its kernels: `rasterization`, relocation, selective Adam, 2DGS refused."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import sys
import types
from typing import Any

import torch
from hosts.cpu_host.rendering import Drawn, draw, view_colors
from splatting.camera import Camera
from splatting.metrics import ssim_map
from splatting.relocation import relocated_values
from torch import Tensor

Geometry = tuple[Tensor, Tensor, Tensor, Tensor]  # means, quats, scales, opacities
IGNORED = (
    *("near_plane", "far_plane", "radius_clip", "eps2d", "tile_size", "channel_chunk", "segmented"),
    *("rays", "global_z_order", "radial_coeffs", "tangential_coeffs", "thin_prism_coeffs"),
    *("ftheta_coeffs", "lidar_coeffs", "external_distortion_coeffs", "rolling_shutter"),
    *("viewmats_rs", "ut_params", "renderer_config"),
)
REFUSED = ("covars", "with_ut", "with_eval3d", "return_normals", "extra_signals", "distributed")


def install() -> None:
    """Replace what needs a kernel in the gsplat that is importable."""
    import torch.utils.cpp_extension as extension

    extension._find_cuda_home = lambda: None  # type: ignore[assignment]  # builds nothing
    gsplat: Any = importlib.import_module("gsplat")
    rendering: Any = importlib.import_module("gsplat.rendering")
    ops: Any = importlib.import_module("gsplat.strategy.ops")
    torch_impl: Any = importlib.import_module("gsplat.cuda._torch_impl")
    one_radius = getattr(gsplat, "__version__", "9").startswith(("1.3", "1.4"))

    def rasterization(*args: Any, **kwargs: Any) -> Any:
        return rasterize(*args, one_radius=one_radius, **kwargs)

    gsplat.rasterization = rendering.rasterization = rasterization
    ops.compute_relocation = _relocation
    ops.quat_scale_to_covar_preci = torch_impl._quat_scale_to_covar_preci
    with contextlib.suppress(ImportError):  # gsplat before 1.5 has none
        selective: Any = importlib.import_module("gsplat.optimizers.selective_adam")
        selective.adam = masked_adam
    # A CUDA extension; what is there already may be a stand-in.
    if "ppisp" not in sys.modules and importlib.util.find_spec("ppisp") is None:
        ppisp: Any = types.ModuleType("ppisp")
        report: Any = types.ModuleType("ppisp.report")
        ppisp.PPISP, ppisp.PPISPConfig = FrameGains, types.SimpleNamespace
        report.export_ppisp_report = lambda *_, **__: []
        sys.modules.update({"ppisp": ppisp, "ppisp.report": report})


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
    packed: bool = True,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    camera_model: str = "pinhole",
    one_radius: bool = False,
    **others: Any,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """gsplat.rasterization for pinhole cameras; see there for the arguments.

    `absgrad` is the gradient's absolute value, not the sum of the pixels' absolute values, which
    is larger: a strategy that goes by it splits less.
    """
    wrong = [name for name in REFUSED if others.get(name)]
    wrong += [name for name in others if name not in (*IGNORED, *REFUSED)]
    if camera_model != "pinhole" or rasterize_mode != "classic" or wrong:
        raise ValueError(
            f"rasterization on a CPU: camera_model={camera_model!r}, rasterize_mode="
            f"{rasterize_mode!r}, {wrong}, but only pinhole and classic are drawn here"
        )
    count, points = len(viewmats), len(means)
    moved = torch.zeros(count, points, 2, requires_grad=True)
    images, alphas, drawn = [], [], []
    for c in range(count):
        K = Ks[c].detach()
        focal = (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
        view = Camera(viewmats[c], *focal, width, height)
        shown = colors if colors.dim() == 2 or sh_degree is not None else colors[c]
        if sh_degree is not None:
            shown = view_colors(means, colors.float(), sh_degree, view)
        background = None if backgrounds is None else backgrounds[c]
        one = draw(means, quats, scales, opacities, shown[..., :3], view, background, moved[c])
        drawn.append(one)
        alphas.append(one.alpha[..., None])
        images.append(_channels(one, render_mode, (means, quats, scales, opacities), view))
    info = _info(drawn, moved, packed, absgrad, one_radius)
    info.update(width=width, height=height, n_cameras=count, tile_size=16)
    return torch.stack(images), torch.stack(alphas), info


def _channels(one: Drawn, mode: str, geometry: Geometry, view: Camera) -> Tensor:
    """The image, the (expected) depth, or both."""
    if mode == "RGB":
        return one.image
    depth = draw(*geometry, one.depths.clamp(min=0)[:, None].expand(-1, 3), view).image[..., :1]
    if "ED" in mode:
        depth = depth / one.alpha[..., None].clamp(min=1e-10)
    return torch.cat([one.image, depth], -1) if "RGB" in mode else depth


def _info(
    drawn: list[Drawn], moved: Tensor, packed: bool, absgrad: bool, one_radius: bool
) -> dict[str, Any]:
    """What gsplat's strategies read: the leaf `moved` is where the 2D gradients arrive."""
    values = torch.stack([d.means2d for d in drawn])
    radii = torch.stack([d.radii for d in drawn]).int()
    ids = torch.stack([d.visible for d in drawn]).nonzero()
    depths = torch.stack([d.depths.detach() for d in drawn])
    opacity = {"camera_ids": None, "gaussian_ids": None}
    if packed:
        cameras, gaussians = ids.unbind(1)
        values, radii, depths = (v[cameras, gaussians] for v in (values, radii, depths))
        opacity = {"camera_ids": cameras, "gaussian_ids": gaussians}
    means2d = _Projected(values, moved, ids if packed else None, absgrad)
    shape = radii if one_radius else torch.stack([radii, radii], -1)
    return {"means2d": means2d.tensor, "radii": shape, "depths": depths, **opacity}


class FrameGains(torch.nn.Module):
    """A gain of each photo, in the place of `ppisp.PPISP`, for what that does to the Gaussians."""

    def __init__(self, num_cameras: int, num_frames: int, config: Any) -> None:
        super().__init__()
        self.gains = torch.nn.Parameter(torch.zeros(num_frames))

    def create_optimizers(self) -> list[torch.optim.Adam]:
        """One for the gains."""
        return [torch.optim.Adam([self.gains], lr=1e-3)]

    def create_schedulers(self, optimizers: list[Any], max_optimization_iters: int) -> list[Any]:
        """Their rate falls to a hundredth."""
        gamma = 0.01 ** (1 / max_optimization_iters)
        return [torch.optim.lr_scheduler.ExponentialLR(each, gamma) for each in optimizers]

    def get_regularization_loss(self) -> Tensor:
        """Small where the gains are."""
        return self.gains.square().mean()

    def forward(self, rgb: Tensor, *, frame_idx: int | None = None, **_: Any) -> Tensor:
        return rgb if frame_idx is None else rgb * self.gains[frame_idx].exp()


class _Projected:
    """The projected means as gsplat's `info` has them, whose gradient is that of `moved`."""

    def __init__(self, values: Tensor, moved: Tensor, ids: Tensor | None, absgrad: bool) -> None:
        self.tensor = values.detach().clone().requires_grad_(moved.requires_grad)
        tensor = self.tensor

        def arrived(grad: Tensor) -> None:
            mine = grad if ids is None else grad[ids[:, 0], ids[:, 1]]
            tensor.grad = mine if tensor.grad is None else tensor.grad + mine
            if absgrad:
                tensor.absgrad = tensor.grad.abs()  # type: ignore[attr-defined]

        if moved.requires_grad:
            moved.register_hook(arrived)


def _relocation(
    opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor, min_opacity: float = 0.0
) -> tuple[Tensor, Tensor]:
    new_opacities, new_scales = relocated_values(opacities.flatten(), scales, ratios)
    return new_opacities.clamp(min=min_opacity).reshape(opacities.shape), new_scales


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
