"""`opt3dgs doctor`: versions, what runs on this machine and why, and a self-test."""

from __future__ import annotations

import argparse
import importlib.metadata
import logging
import math
import platform
import sys
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn import Parameter

from opt3dgs_optim import triton
from opt3dgs_optim.lbfgs import history_from_pairs, lqn_direction, two_loop
from opt3dgs_optim.lbfgs.backend import Backend, backend_info
from opt3dgs_optim.lqnadam import LQNAdam
from opt3dgs_optim.messages import LOGGER
from opt3dgs_optim.phases import PhaseScheduler
from opt3dgs_optim.version import __version__

ROWS, HISTORY_SIZE, STEPS = 1000, 5, 60
# Sums of a few dozen products, in another order.
LIMITS = {torch.float64: 1e-10, torch.float32: 1e-4}
STEP_LIMIT = 2e-5  # float32 over 60 steps
SHAPES = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh0": (1, 3)}
NOT_RUN = "--"


def versions(device: torch.device) -> dict[str, str]:
    """The package, what it stands on, and what runs on `device`."""
    info, threads = backend_info(device), torch.get_num_threads()
    gpu = torch.cuda.get_device_name(device) if device.type == "cuda" else None
    missing = triton.missing()
    step = "one Triton launch a parameter" if missing is None else f"torch operations: {missing}"
    return {
        "opt3dgs_optim": __version__,
        "python": f"{platform.python_version()}, {platform.platform()}",
        "torch": f"{torch.__version__}, CUDA {torch.version.cuda or 'is not built in'}",
        "numpy": np.__version__,
        "triton": _installed("triton") or _installed("triton-windows") or "not installed",
        "cuda.core": _installed("cuda-core") or "not installed (only curvature kernels need it)",
        "device": f"{device}: {gpu or f'{platform.machine()}, torch threads: {threads}'}",
        "step": step,
        "curvature": f"{info.backend}: {info.reason}",
    }


def _installed(distribution: str) -> str | None:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


def _draw(*shape: int, device: torch.device, seed: int = 0) -> Tensor:
    # Drawn on the CPU, so that every device gets the same numbers.
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64, device="cpu").to(device)


def adam_when_all_is_off(device: torch.device) -> str:
    """A first step of LQNAdam, which has no pairs yet, is torch's Adam's."""
    ours = Parameter(_draw(ROWS, 3, device=device).float())
    theirs = Parameter(ours.detach().clone())
    for x, make in ((ours, LQNAdam), (theirs, torch.optim.Adam)):
        x.grad = _draw(ROWS, 3, device=device, seed=1).float()
        make([x], lr=0.01).step()
    # A CPU adds and multiplies as torch's own loop does; a device may round once where that does.
    limit = 0.0 if device.type == "cpu" else STEP_LIMIT
    found = _difference(ours, theirs)
    return _within(limit, "LQNAdam's first step differs from torch's Adam's by", found)


def default_step(device: torch.device) -> str:
    """A short training of the default parts on the device, against the CPU in float64."""

    def train(place: torch.device, dtype: torch.dtype) -> list[Tensor]:
        params = {
            name: Parameter(_draw(ROWS, *shape, device=place, seed=i).to(dtype))
            for i, (name, shape) in enumerate(SHAPES.items())
        }
        optimizers = {name: torch.optim.Adam([p], lr=0.01) for name, p in params.items()}
        phases = PhaseScheduler(STEPS)
        phases.upgrade(optimizers)
        for step in range(STEPS):
            for i, param in enumerate(params.values()):
                param.grad = _draw(*param.shape, device=place, seed=100 * step + i).to(dtype)
            for optimizer in optimizers.values():
                optimizer.step()
        return [param.detach().cpu() for param in params.values()]

    exact = train(torch.device("cpu"), torch.float64)
    pairs = zip(train(device, torch.float32), exact, strict=True)
    worst = max(_difference(ours, theirs) for ours, theirs in pairs)
    return _within(STEP_LIMIT, f"{STEPS} default steps differ from float64's by", worst)


def curvature_kernels(device: torch.device) -> str:
    """The CUDA kernels of the two-loop recursion against the same in torch."""
    info = backend_info(device)
    if info.backend != "cuda":
        raise NotRunError(info.reason)
    found = []
    for dtype, limit in LIMITS.items():
        for name, run in (("lqn_direction", _direction), ("two_loop", _recursion)):
            difference = _difference(run(device, dtype, "cuda"), run(device, dtype, "torch"))
            found.append(_within(limit, f"{name} in {dtype} differs from torch by", difference))
    return "; ".join(found)


def _pairs(device: torch.device) -> tuple[Tensor, Tensor]:
    """Parameter and gradient differences [K, N, 3] of quadratics, so that s.y > 0."""
    s = _draw(HISTORY_SIZE, ROWS, 3, device=device, seed=1)
    half = _draw(ROWS, 3, 3, device=device, seed=2)
    hessian = half @ half.mT + torch.eye(3, dtype=s.dtype, device=device)
    return s, torch.einsum("nij,knj->kni", hessian, s)


def _direction(device: torch.device, dtype: torch.dtype, backend: Backend) -> Tensor:
    s, y = (tensor.to(dtype) for tensor in _pairs(device))
    position, grad = _draw(2, ROWS, 3, device=device, seed=5).to(dtype)
    given = position, grad, history_from_pairs(s, y), HISTORY_SIZE
    return lqn_direction(*given, min_cosine=1e-6, graft=True, backend=backend)[0]


def _recursion(device: torch.device, dtype: torch.dtype, backend: Backend) -> Tensor:
    s, y = (tensor.to(dtype) for tensor in _pairs(device))
    grad = _draw(ROWS, 3, device=device, seed=5).to(dtype)
    return two_loop(grad, history_from_pairs(s, y), HISTORY_SIZE, backend=backend)


def _difference(ours: Tensor, theirs: Tensor) -> float:
    """The largest difference, as a share of the largest number; infinite where one is NaN."""
    found = float((ours - theirs).detach().abs().max() / theirs.detach().abs().max())
    return math.inf if math.isnan(found) else found  # `max` of numbers would pass over it


def _within(limit: float, what: str, difference: float) -> str:
    found = f"{what} {difference:.1e} (limit {limit:.0e})"
    if not difference <= limit:  # NaN too
        raise ArithmeticError(found)
    return found


class NotRunError(Exception):
    """A check that this machine cannot run, and why."""


CHECKS: dict[str, Callable[[torch.device], str]] = {
    "Adam with all off": adam_when_all_is_off,
    "default step": default_step,
    "kernels of the curvature": curvature_kernels,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; 0, 1 if a check failed, 2 after one line that says what is wrong."""
    parser = argparse.ArgumentParser(
        prog="opt3dgs doctor",
        description="Versions, backend and self-test of opt3dgs_optim on this machine.",
    )
    parser.add_argument("--device", help="where to look (default: the GPU, if torch sees one)")
    LOGGER.addHandler(logging.NullHandler())  # the self-test's trainings say nothing
    name = parser.parse_args(arguments).device or ("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.zeros(1, device=name).device
    except (AssertionError, NotImplementedError, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        print(f"doctor: --device {name!r}: torch cannot use it here: {reason}", file=sys.stderr)
        return 2
    for what, version in versions(device).items():
        print(f"{what:<14} {version}")
    print("\nSelf-test")
    failed = 0
    for name, check in CHECKS.items():
        try:
            mark, detail = "ok", check(device)
        except NotRunError as reason:
            mark, detail = NOT_RUN, f"not run: {reason}"
        except Exception as error:  # whatever a broken installation raises is the finding
            mark, detail = "FAILED", f"{type(error).__name__}: {error}"
            failed += 1
        print(f"  {mark:<7} {name}: {detail}")
    if failed:
        print(f"\n{failed} of {len(CHECKS)} FAILED: this installation gives wrong numbers.")
    return 1 if failed else 0
