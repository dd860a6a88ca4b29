"""The two operators that have a CUDA kernel: one schema each, pure torch on every other device.

`torch.ops.opt3dgs_optim.lqn_direction` and `.add_covariance_noise` work under `torch.compile`.
`torch.library.custom_op` would cost 12 us per call; define, impl and register_fake cost 1.4.
"""

from __future__ import annotations

import torch
from torch import Tensor

from opt3dgs_optim import cuda, curvature
from opt3dgs_optim._covariance import GATE_OPACITY, GATE_SHARPNESS, covariance_noise_
from opt3dgs_optim.backend import uses_kernel

_LIBRARY = torch.library.Library("opt3dgs_optim", "DEF")
_LIBRARY.define(
    "lqn_direction(Tensor position, Tensor grad, Tensor(a!) history, int history_size, *, "
    "float min_cosine, bool powell, bool graft, float[]? gamma_clamp, str backend) "
    "-> (Tensor direction, Tensor accepted, Tensor candidates)"
)
_LIBRARY.define(
    "add_covariance_noise(Tensor(a!) means, Tensor scales, Tensor quats, Tensor opacities, "
    "Tensor eta, Tensor lr, *, float noise_scale, float sharpness, float threshold, str backend) "
    "-> ()"
)


def lqn_direction(
    position: Tensor,
    grad: Tensor,
    history: Tensor,
    history_size: int,
    *,
    min_cosine: float,
    powell: bool,
    graft: bool,
    gamma_clamp: tuple[float, float] | None,
    backend: str = "auto",
) -> tuple[Tensor, Tensor, Tensor]:
    """One step of the per-point L-BFGS: `curvature.record`, then `curvature.direction`.

    Args:
        position: [N, 3] before the step.
        grad: [N, 3]; a row that is zero or not finite is not visible: its history stays, and it
            is given back.
        history: [N, slots, 8], changed in place; see `curvature`.
        history_size: K, 1 to 16.
        min_cosine, powell, graft, gamma_clamp: see `LQNAdam`.
        backend: "auto", "cuda" or "torch".

    Returns:
        (direction [N, 3], accepted [N] bool, candidates [N] bool).

    Raises:
        RuntimeError: `backend="cuda"` where the kernel cannot run.
        ValueError: the shapes do not fit.
    """
    clamp = None if gamma_clamp is None else list(gamma_clamp)
    return torch.ops.opt3dgs_optim.lqn_direction(
        position,
        grad,
        history,
        history_size,
        min_cosine=min_cosine,
        powell=powell,
        graft=graft,
        gamma_clamp=clamp,
        backend=backend,
    )


def add_covariance_noise(
    means: Tensor,
    scales: Tensor,
    quats: Tensor,
    opacities: Tensor,
    eta: Tensor,
    lr: Tensor,
    *,
    noise_scale: float,
    sharpness: float = GATE_SHARPNESS,
    threshold: float = GATE_OPACITY,
    backend: str = "auto",
) -> None:
    """Add eq. 2's noise, `lr * noise_scale * covariance_noise(...)`, to `means` in place.

    Args:
        means: [N, 3] world units, changed in place.
        scales: [N, 3] log of the standard deviations.
        quats: [N, 4] wxyz, need not be normalised.
        opacities: [N] or [N, 1] logits.
        eta: [N, 3] standard normal.
        lr: 0-d, on the means' device (read when the step runs) or on the CPU.
        noise_scale: noise_lr of 3DGS-MCMC.
        sharpness, threshold: k and t of the gate.
        backend: "auto", "cuda" or "torch".

    Raises:
        RuntimeError: `backend="cuda"` where the kernel cannot run.
        ValueError: the shapes do not fit.
    """
    torch.ops.opt3dgs_optim.add_covariance_noise(
        means,
        scales,
        quats,
        opacities,
        eta,
        lr,
        noise_scale=noise_scale,
        sharpness=sharpness,
        threshold=threshold,
        backend=backend,
    )


# -- lqn_direction ---------------------------------------------------------------------------------


def _lqn_direction(
    position: Tensor,
    grad: Tensor,
    history: Tensor,
    history_size: int,
    *,
    min_cosine: float,
    powell: bool,
    graft: bool,
    gamma_clamp: list[float] | None,
    backend: str,
) -> tuple[Tensor, Tensor, Tensor]:
    clamp = None if gamma_clamp is None else (gamma_clamp[0], gamma_clamp[1])
    if uses_kernel(backend, grad.device, grad.dtype):
        _check_points("lqn_direction", grad, {"position": position}, history.dtype)
        curvature.check_history("lqn_direction", grad, history, history_size)
        return cuda.lqn_direction(
            position, grad, history, history_size, min_cosine, powell, graft, clamp
        )
    return curvature.step(
        position,
        grad,
        history,
        history_size,
        min_cosine=min_cosine,
        powell=powell,
        graft=graft,
        gamma_clamp=clamp,
    )


def _fake_lqn_direction(
    position: Tensor, grad: Tensor, history: Tensor, history_size: int, **options: object
) -> tuple[Tensor, Tensor, Tensor]:
    flags = [grad.new_empty(grad.shape[0], dtype=torch.bool) for _ in range(2)]
    direction = torch.empty_like(grad, memory_format=torch.contiguous_format)
    return direction, flags[0], flags[1]


def _check_points(call: str, like: Tensor, others: dict[str, Tensor], dtype: torch.dtype) -> None:
    """A kernel reads memory by these shapes: be sure of them."""
    if like.dim() != 2 or like.shape[1] != 3:
        raise ValueError(f"{call}: a tensor has shape {tuple(like.shape)}, but [N, 3] is needed")
    for name, tensor in others.items():
        if tensor.shape != like.shape or tensor.dtype != dtype or tensor.device != like.device:
            raise ValueError(
                f"{call}: {name} is {tuple(tensor.shape)} {tensor.dtype} on {tensor.device}, but "
                f"{tuple(like.shape)} {dtype} on {like.device} is needed"
            )


# -- add_covariance_noise --------------------------------------------------------------------------


def _add_covariance_noise(
    means: Tensor,
    scales: Tensor,
    quats: Tensor,
    opacities: Tensor,
    eta: Tensor,
    lr: Tensor,
    *,
    noise_scale: float,
    sharpness: float,
    threshold: float,
    backend: str,
) -> None:
    opacities = opacities.reshape(-1)
    if uses_kernel(backend, means.device, means.dtype):
        rows = {
            "scales": scales,
            "quats": quats[:, 1:],
            "opacities": opacities.unsqueeze(1).expand(-1, 3),
            "eta": eta,
        }
        _check_points("add_covariance_noise", means, rows, means.dtype)
        tensors = (means, scales, quats, opacities, eta, lr)
        cuda.add_covariance_noise(*tensors, noise_scale, sharpness, threshold)
        return
    covariance_noise_(means, scales, quats, opacities, eta, lr * noise_scale, sharpness, threshold)


def _fake_add_covariance_noise(means: Tensor, *tensors: Tensor, **options: object) -> None:
    return None


for _name, _body, _fake in (
    ("lqn_direction", _lqn_direction, _fake_lqn_direction),
    ("add_covariance_noise", _add_covariance_noise, _fake_add_covariance_noise),
):
    _LIBRARY.impl(_name, _body, "CompositeExplicitAutograd")
    torch.library.register_fake(f"opt3dgs_optim::{_name}", _fake, lib=_LIBRARY)
