"""Is everything in order here? `opt3dgs doctor`.

Prints versions, which backend runs and why, and a self-test of this installation. Ends with 0, or 1
if a check of the self-test failed; `--json` for programs.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import platform
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch

from opt3dgs_optim.backend import backend_info
from opt3dgs_optim.doctor_checks import Check, run_checks
from opt3dgs_optim.version import __version__

__all__ = ["examine", "main"]

MARKS = {"ok": "ok", "failed": "FAILED", "skipped": "--"}


def examine(device: torch.device) -> dict[str, Any]:
    """Everything the doctor finds, as JSON holds it."""
    info = backend_info(device)
    begin = time.perf_counter()
    checks = run_checks(device)
    seconds = time.perf_counter() - begin
    return {
        "versions": versions(),
        "device": device_name(device),
        "backend": {"in_use": info.backend, "reason": info.reason, "advice": advice(device)},
        "self_test_seconds": round(seconds, 3),
        "checks": [asdict(check) for check in checks],
        "passed": all(check.outcome != "failed" for check in checks),
    }


def versions() -> dict[str, str | None]:
    """Versions of the package and of what it stands on; None for what is not installed."""
    return {
        "opt3dgs_optim": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "torch": torch.__version__,
        "cuda_of_torch": torch.version.cuda,
        "numpy": np.__version__,
        "cuda_core": _installed("cuda-core"),
        "matplotlib": _installed("matplotlib"),
    }


def _installed(distribution: str) -> str | None:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


def device_name(device: torch.device) -> str:
    """The GPU's name, or the processor's with the number of torch's threads."""
    if device.type == "cuda":
        return f"{device}: {torch.cuda.get_device_name(device)}"
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    threads = torch.get_num_threads()
    many = "1 thread" if threads == 1 else f"{threads} threads"
    return f"{device}: {names[0] if names else platform.machine()}, {many}"


def advice(device: torch.device) -> str | None:
    """The command that would bring the kernels, where nothing else is in their way."""
    if device.type != "cuda" or torch.version.cuda is None or _installed("cuda-core"):
        return None
    extra = "cuda12" if torch.version.cuda.startswith("12") else "cuda"
    return f"pip install 'opt3dgs_optim[{extra}]'"


def as_text(found: dict[str, Any]) -> str:
    """What `examine` found, for people."""
    checks = [Check(**check) for check in found["checks"]]
    parts = [_versions_text(found), _checks_text(checks, found["self_test_seconds"])]
    failed = sum(check.outcome == "failed" for check in checks)
    skipped = sum(check.outcome == "skipped" for check in checks)
    parts.append(
        f"{failed} of {len(checks)} checks FAILED: this installation gives wrong numbers, or none."
        if failed
        else f"In order: {len(checks) - skipped} checks passed"
        + (f", {skipped} could not be made here." if skipped else ".")
    )
    return "\n\n".join(parts)


def _versions_text(found: dict[str, Any]) -> str:
    version, backend = found["versions"], found["backend"]
    cuda = version["cuda_of_torch"]
    rows = {
        "opt3dgs_optim": version["opt3dgs_optim"],
        "python": f"{version['python']}, {version['platform']}",
        "torch": f"{version['torch']}, " + (f"CUDA {cuda}" if cuda else "built without CUDA"),
        "numpy": version["numpy"],
        "cuda.core": version["cuda_core"] or "not installed (only the kernels need it)",
        "matplotlib": version["matplotlib"] or "not installed (only pictures need it)",
        "device": found["device"],
        "backend": f"{backend['in_use']}: {backend['reason']}",
    }
    if backend["advice"]:
        rows["advice"] = f"for the kernels: {backend['advice']}"
    return "\n".join(f"{name:<14} {value}" for name, value in rows.items())


def _checks_text(checks: Sequence[Check], seconds: float) -> str:
    rows = [f"  {MARKS[check.outcome]:<7} {check.name}: {check.detail}" for check in checks]
    return "\n".join([f"Self-test ({seconds:.1f} s)", *rows])


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="opt3dgs doctor",
        description="Versions, backend and self-test of opt3dgs_optim on this machine.",
    )
    parser.add_argument("--device", help="where to look (default: the GPU, if torch sees one)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; 0, 1 if a check failed, 2 after one line that says what is wrong."""
    options = _parser().parse_args(arguments)
    try:
        device = _device(options.device)
    except ValueError as error:
        print(f"doctor: {error}", file=sys.stderr)
        return 2
    found = examine(device)
    print(json.dumps(found, indent=2) if options.json else as_text(found))
    return 0 if found["passed"] else 1


def _device(name: str | None) -> torch.device:
    """The device of that name, proved by a tensor on it; ValueError if it cannot be used."""
    if name is None:
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        return torch.zeros(1, device=name).device
    except (AssertionError, NotImplementedError, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"--device {name!r}: torch cannot use it here: {reason}") from None


if __name__ == "__main__":
    raise SystemExit(main())
