"""What the tests of real trainers' scripts have in common: sources, packages, judgement."""

from __future__ import annotations

import importlib.util
import math
import os
from pathlib import Path

import pytest
from hosts.trials import Done, Trial

TRAINERS = Path(os.environ.get("OPT3DGS_TRAINERS", "/no/trainers"))
# Lightning 2.3, whose command line reads its own checkpoints, and what that needs.
LIGHTNING = "lightning jsonargparse docstring_parser typeshed_client pkg_resources torchmetrics"
NEEDED = {
    "gsplat": "torchmetrics tyro cv2 sklearn yaml imageio",
    "gsplat-main": "pycolmap piexif",
    "gaussian-splatting-lightning": f"{LIGHTNING} plyfile tensorboard",
    "CityGaussian": f"{LIGHTNING} plyfile tensorboard",
    "nerfstudio": "torchmetrics tyro cv2 sklearn yaml imageio nerfacc pytorch_msssim rawpy mediapy "
    "appdirs requests pyquaternion fpsample",
}
OURS = 1.5  # dB that an edited run of 100 iterations may be worse than the stock one


def need(trial: Trial) -> None:
    """Skip the test where the trainer's sources, or packages that it imports, are not there."""
    if not (TRAINERS / trial.trainer / trial.script).is_file():
        pytest.skip(f"no {TRAINERS / trial.trainer}: put its sources there, set OPT3DGS_TRAINERS")
    for host, names in NEEDED.items():
        missing = [name for name in names.split() if not importlib.util.find_spec(name)]
        if trial.trainer.startswith(host) and missing:
            pytest.skip(f"{host} needs {', '.join(missing)}: pip install them")


def no_worse(done: Done, begun: Done, allowed: float) -> None:
    """Fail where a training ends more than `allowed` dB below the one that it is compared with."""
    assert (done.psnr is None) == (begun.psnr is None)
    if done.psnr is not None and begun.psnr is not None:
        assert math.isfinite(done.psnr)
        assert done.psnr > begun.psnr - allowed
