"""`opt3dgs doctor`: versions, backend and why, a self-test of what an installation can break."""

import argparse
import importlib.metadata
import platform
import sys
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from opt3dgs_optim import cuda
from opt3dgs_optim.awsgld import AWSGLD
from opt3dgs_optim.backend import Backend, backend_info
from opt3dgs_optim.frames import axes_of, repeated_columns
from opt3dgs_optim.lbfgs import history_from_pairs, lqn_direction, two_loop
from opt3dgs_optim.lqnadam import LQNAdam
from opt3dgs_optim.parts.histogram import EnergyHistogram
from opt3dgs_optim.version import __version__

ROWS, HISTORY_SIZE = 1000, 5
MIN_ASPECT = 0.1  # of the own frames
# Sums of a few dozen products, in another order.
LIMITS = {torch.float64: 1e-10, torch.float32: 1e-4}
ENERGIES = 400  # of them 150 after the warm-up
HISTOGRAM_LIMIT = 1e-3  # float32 over as many updates, which forget


def versions(device: torch.device) -> dict[str, str]:
    """The package, what it stands on, and what runs on `device`."""
    info, threads = backend_info(device), torch.get_num_threads()
    gpu = torch.cuda.get_device_name(device) if device.type == "cuda" else None
    return {
        "opt3dgs_optim": __version__,
        "python": f"{platform.python_version()}, {platform.platform()}",
        "torch": f"{torch.__version__}, CUDA {torch.version.cuda or 'is not built in'}",
        "numpy": np.__version__,
        "cuda.core": _installed("cuda-core") or "not installed (only the kernels need it)",
        "matplotlib": _installed("matplotlib") or "not installed (only pictures need it)",
        "device": f"{device}: {gpu or f'{platform.machine()}, torch threads: {threads}'}",
        "backend": f"{info.backend}: {info.reason}",
    }


def _installed(distribution: str) -> str | None:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


def _draw(*shape: int, device: torch.device, seed: int = 0) -> Tensor:
    # Drawn on the CPU, so that every device gets the same numbers.
    generator = torch.Generator().manual_seed(seed)
    like = {"dtype": torch.float64, "device": "cpu"}
    return torch.randn(*shape, generator=generator, **like).to(device)


def _pairs(device: torch.device) -> tuple[Tensor, Tensor]:
    """Parameter and gradient differences [K, N, 3] of quadratics, so that s.y > 0."""
    s = _draw(HISTORY_SIZE, ROWS, 3, device=device, seed=1)
    half = _draw(ROWS, 3, 3, device=device, seed=2)
    hessian = half @ half.mT + torch.eye(3, dtype=s.dtype, device=device)
    return s, torch.einsum("nij,knj->kni", hessian, s)


def adam_when_all_is_off(device: torch.device) -> str:
    """nu and noise off is torch's Adam, bit for bit; so is a first step without pairs."""
    for make, steps in ((AWSGLD, 5), (LQNAdam, 1)):
        ours = torch.nn.Parameter(_draw(ROWS, 3, device=device).float())
        theirs = torch.nn.Parameter(ours.detach().clone())
        optimizers = make([ours], lr=0.01), torch.optim.Adam([theirs], lr=0.01)
        for step in range(steps):
            for x, optimizer in zip((ours, theirs), optimizers, strict=True):
                x.grad = _draw(ROWS, 3, device=device, seed=step).float()
                optimizer.step()
        if not torch.equal(ours, theirs):
            raise ArithmeticError(f"{make.__name__} with nothing on differs from torch.optim.Adam")
    return "AWSGLD without histogram and noise, and LQNAdam's first step: bit for bit torch's Adam"


def _curvature_step(device: torch.device, dtype: torch.dtype, backend: Backend) -> Tensor:
    s, y = (tensor.to(dtype) for tensor in _pairs(device))
    position, grad = _draw(2, ROWS, 3, device=device, seed=5).to(dtype)
    given = position, grad, history_from_pairs(s, y), HISTORY_SIZE
    return lqn_direction(*given, min_cosine=1e-6, graft=True, backend=backend)[0]


def _recursion(device: torch.device, dtype: torch.dtype, backend: Backend) -> Tensor:
    s, y = (tensor.to(dtype) for tensor in _pairs(device))
    grad = _draw(ROWS, 3, device=device, seed=5).to(dtype)
    return two_loop(grad, history_from_pairs(s, y), HISTORY_SIZE, backend=backend)


def _own_frame(device: torch.device, dtype: torch.dtype, backend: Backend) -> Tensor:
    """B^T v and B v of the frames B = R diag(exp(scales)), whose thin axes have a least length."""
    vectors, scales = _draw(2, ROWS, 3, device=device, seed=7).to(dtype)
    quats = _draw(ROWS, 4, device=device, seed=8).to(dtype)
    if backend == "cuda":
        given = vectors, quats, scales, MIN_ASPECT
        return torch.cat([cuda.own_frame_gradient(*given), cuda.own_frame_displacement(*given)])
    axes = axes_of(quats, scales, dtype, MIN_ASPECT)
    each = [repeated_columns(vectors, dtype) for _ in range(4)]
    return torch.cat([axes.into(*each[:2]).T, axes.out_of(*each[2:]).T])


# What each kernel is compared in.
KERNELS: dict[str, Callable[[torch.device, torch.dtype, Backend], Tensor]] = {
    "lqn_direction": _curvature_step,
    "two_loop": _recursion,
    "own_frame": _own_frame,
}


def kernels_against_torch(device: torch.device) -> str:
    """The CUDA kernels against the same in torch; RuntimeError where they cannot run."""
    found = []
    for dtype, limit in LIMITS.items():
        differences = []
        for name, run in KERNELS.items():
            ours, theirs = run(device, dtype, "cuda"), run(device, dtype, "torch")
            difference = float((ours - theirs).abs().max() / theirs.abs().max())
            differences.append(f"{name} {difference:.1e}")
            if not difference <= limit:  # NaN too
                raise ArithmeticError(
                    f"{name} differs from torch by {difference:.1e} in {dtype} (limit {limit:.0e})"
                )
        found.append(f"{', '.join(differences)} in {dtype} (limit {limit:.0e})")
    return f"relative differences to torch: {'; '.join(found)}"


def histogram_kernel(device: torch.device) -> str:
    """The histogram on the device, a kernel, against the same on the host, which is torch's."""
    energies = 0.1 + 0.01 * _draw(ENERGIES, device=torch.device("cpu"), seed=6)
    ours, theirs = EnergyHistogram(), EnergyHistogram()
    for energy in energies:
        ours.observe(energy.to(device, torch.float32))
        theirs.observe(energy.float())
    difference = float((ours.mean_multiplier.cpu() - theirs.mean_multiplier).abs())
    found = f"mean multiplier of {ENERGIES} energies differs by {difference:.1e}"
    found += f" (limit {HISTOGRAM_LIMIT:.0e})"
    if not difference <= HISTOGRAM_LIMIT:
        raise ArithmeticError(found)
    return found


CHECKS: dict[str, Callable[[torch.device], str]] = {
    "Adam with all off": adam_when_all_is_off,
    "CUDA kernels": kernels_against_torch,
    "histogram on CUDA": histogram_kernel,
}
NEED_KERNELS = (kernels_against_torch, histogram_kernel)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; 0, 1 if a check failed, 2 after one line that says what is wrong."""
    parser = argparse.ArgumentParser(
        prog="opt3dgs doctor",
        description="Versions, backend and self-test of opt3dgs_optim on this machine.",
    )
    parser.add_argument("--device", help="where to look (default: the GPU, if torch sees one)")
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
    info, failed = backend_info(device), 0
    for name, check in CHECKS.items():
        mark, detail = "--", f"not launched: {info.reason}"
        if check not in NEED_KERNELS or info.backend == "cuda":
            try:
                mark, detail = "ok", check(device)
            except Exception as error:  # whatever a broken installation raises is the finding
                mark, detail = "FAILED", f"{type(error).__name__}: {error}"
                failed += 1
        print(f"  {mark:<7} {name}: {detail}")
    if failed:
        print(f"\n{failed} of {len(CHECKS)} FAILED: this installation gives wrong numbers.")
    return 1 if failed else 0
