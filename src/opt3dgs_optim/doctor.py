"""Is everything in order here? `opt3dgs doctor`: versions, backend and why, a self-test."""

from __future__ import annotations

import argparse
import importlib.metadata
import platform
import sys
from collections.abc import Sequence

import numpy as np
import torch

from opt3dgs_optim.backend import backend_info
from opt3dgs_optim.doctor_checks import run_checks
from opt3dgs_optim.version import __version__

MARKS = {"ok": "ok", "failed": "FAILED", "skipped": "--"}


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
    checks = run_checks(device)
    print("\nSelf-test")
    for check in checks:
        print(f"  {MARKS[check.outcome]:<7} {check.name}: {check.detail}")
    outcomes = [check.outcome for check in checks]
    if failed := outcomes.count("failed"):
        print(f"\n{failed} of {len(checks)} checks FAILED: this installation gives wrong numbers.")
        return 1
    passed, skipped = outcomes.count("ok"), outcomes.count("skipped")
    print(f"\nIn order: {passed} checks passed, {skipped} could not be made here.")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
