"""Run a trainer's real script on a machine without a GPU, to try it before renting one.

    python examples/hosts/on_cpu.py simple_trainer.py mcmc --data_dir SCENE --max_steps 100
    python examples/hosts/on_cpu.py train.py -s SCENE --iterations 100
    python examples/hosts/on_cpu.py nerfstudio/scripts/train.py splatfacto-opt3dgs \
        --vis tensorboard --max-num-iterations 100 colmap --data SCENE --colmap-path sparse/0
    python examples/hosts/on_cpu.py gaussian-splatting-lightning/main.py fit --config opt3dgs.yaml \
        --data.path SCENE --data.parser Colmap --trainer.accelerator cpu --max_steps 100

Everything after the script's path is the script's own. CUDA is mapped to the CPU, the CUDA
rasterizers are replaced by the examples' own (`pip install "opt3dgs_optim[examples]"`), viewers and
loggers that are not installed by ones that do nothing; the script itself is not touched. With a
hundred iterations on photos of 160 x 106 pixels, a minute or two show whether the lines of
`opt3dgs hosts diff` work in your trainer: not how good the result gets.

What is not as on a GPU: pinhole cameras without distortion only; no antialiased mode, no 2DGS, no
depth supervision in INRIA's trainer; the absolute gradients of `absgrad` and the importances of
mini-splatting and taming-3dgs are estimates; LPIPS is NaN; one process loads the photos.
"""

from __future__ import annotations

import os
import runpy
import sys
from pathlib import Path

EXAMPLES = Path(__file__).resolve().parents[1]


def prepare(script: Path) -> None:
    """Make this process able to run `script`: paths, CUDA, modules."""
    sys.path.insert(0, str(EXAMPLES))
    from hosts.cpu_host import cuda, gsplat_modules, inria_modules, stand_ins

    folder = script.resolve().parent
    package = folder
    while (package / "__init__.py").is_file():  # a script in a package: imported from its root
        package = package.parent
    sys.path.insert(0, str(package))
    os.environ.setdefault("TORCHDYNAMO_DISABLE", "1")  # a hundred iterations compile nothing
    if (folder.parent / "gsplat" / "__init__.py").is_file():  # its own gsplat, not another version
        sys.path.insert(1, str(folder.parent))
    stand_ins.install()
    inria_modules.install(folder)
    cuda.install()
    text = script.read_text(errors="ignore")
    if "gsplat" in text or "nerfstudio" in text:
        gsplat_modules.install()


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
