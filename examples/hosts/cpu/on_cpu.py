"""Run a trainer's real script on a machine without a GPU, to try it before renting one.

    python examples/hosts/cpu/on_cpu.py simple_trainer.py mcmc --data_dir SCENE --max_steps 100
    python examples/hosts/cpu/on_cpu.py train.py -s SCENE --iterations 100

What follows the script's path is the script's own. CUDA is mapped to the CPU, the CUDA rasterizers
are replaced by the examples' own (`pip install ".[examples]"` in a clone), viewers and loggers that
are not installed by ones that do nothing; the script itself is not touched. A hundred iterations on
photos of 160 x 106 pixels show whether the lines work, not how good a result gets.

What is not as on a GPU: pinhole cameras only; 2DGS draws thin Gaussians and has no depths; the
importances of mini-splatting and taming-3dgs are estimates; LPIPS is NaN; one process loads photos.
"""

from __future__ import annotations

import atexit
import importlib
import logging
import os
import random
import runpy
import sys
from pathlib import Path
from typing import Any

EXAMPLES = Path(__file__).resolve().parents[2]


def prepare(script: Path) -> None:
    """Make this process able to run `script`: paths, CUDA, modules."""
    sys.path.insert(0, str(EXAMPLES))
    import cpu_cuda
    import cpu_gsplat
    import cpu_inria
    import cpu_stand_ins

    folder = script.resolve().parent
    package = folder
    while (package / "__init__.py").is_file():  # a script in a package: imported from its root
        package = package.parent
    sys.path.insert(0, str(package))
    os.environ.setdefault("TORCHDYNAMO_DISABLE", "1")  # a hundred iterations compile nothing
    if (folder.parent / "gsplat" / "__init__.py").is_file():  # its own gsplat, not another version
        sys.path.insert(1, str(folder.parent))
    cpu_stand_ins.install()
    cpu_inria.install(folder)
    cpu_cuda.install()
    logging.basicConfig(format="%(message)s")
    logging.getLogger("opt3dgs_optim").setLevel(logging.INFO)
    for root in (package, package.parent):  # mini-splatting's scripts have folders
        if (root / "scene" / "gaussian_model.py").is_file():
            seed_each_iteration(root)
    keep_ends()
    text = script.read_text(errors="ignore")
    if "gsplat" in text or "nerfstudio" in text:
        cpu_gsplat.install()


def seed_each_iteration(package: Path) -> None:
    """Random numbers follow from the iteration, so that a resumed run can be compared.

    INRIA's trainers call `update_learning_rate(iteration)` where an iteration begins. OPT3DGS_SEED
    is of the whole run.
    """
    import torch

    sys.path.insert(0, str(package))
    model: Any = importlib.import_module("scene.gaussian_model").GaussianModel
    stock = model.update_learning_rate
    first = 1_000_003 * int(os.environ.get("OPT3DGS_SEED", "0"))

    def seeded(self: Any, iteration: int) -> Any:
        random.seed(first + iteration)
        torch.manual_seed(first + iteration)
        return stock(self, iteration)

    model.update_learning_rate = seeded


def keep_ends() -> None:
    """Write what a training ended with to OPT3DGS_END: by name, the parameter and its mean."""
    if "OPT3DGS_END" not in os.environ:
        return
    import torch

    from opt3dgs_optim import PhaseScheduler

    begun: list[Any] = []  # schedulers with their optimizers, which they hold weakly
    upgrade: Any = PhaseScheduler.upgrade

    def kept(self: Any, optimizers: Any) -> Any:
        begun.append((self, optimizers))
        return upgrade(self, optimizers)

    def write() -> None:
        ends = {}
        for phases, _ in begun:
            for key in phases.members:
                state = phases.state_of_param(*key) or {}
                ends[key[1]] = phases.param_of(*key).detach(), state.get("averaging.mean")
        torch.save(ends, os.environ["OPT3DGS_END"])

    PhaseScheduler.upgrade = kept  # type: ignore[method-assign]
    atexit.register(write)


def main() -> None:
    """Run the script of the command line."""
    usage = f"{__doc__}\nusage: on_cpu.py [--help] SCRIPT [the script's own arguments]"
    if sys.argv[1:2] in (["--help"], ["-h"]):
        print(usage)
        return
    if len(sys.argv) < 2 or not Path(sys.argv[1]).is_file():
        sys.exit(usage)
    script = Path(sys.argv[1])
    prepare(script)
    sys.argv = sys.argv[1:]
    runpy.run_path(str(script), run_name="__main__")


if __name__ == "__main__":
    main()
