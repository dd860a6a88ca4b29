"""The wheel holds the kernels' sources, and works where it is all there is of the project."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).parent.parent
STEP = """
import torch, opt3dgs_optim
from opt3dgs_optim import LQNAdam, backend_info, cuda
assert {place!r} in opt3dgs_optim.__file__, opt3dgs_optim.__file__
x = torch.nn.Parameter(torch.ones(300, 3))
optimizer = LQNAdam([x], lr=0.1)
for _ in range(5):
    x.grad = x.detach() * torch.tensor([1.0, 10.0, 100.0])
    optimizer.step()
assert float(optimizer.accepted_share) > 0.9
assert "HISTORY_SIZE" in cuda.source("lqn.cu")
print(backend_info("cpu"))
"""

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("hatchling") is None, reason="hatchling is not installed"
)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True)
    return next(folder.glob("*.whl"))


def test_wheel_holds_the_kernels(wheel: Path) -> None:
    assert wheel.name.endswith("py3-none-any.whl")
    names = zipfile.ZipFile(wheel).namelist()
    for name in ("two_loop.cuh", "packed.cuh", "lqn.cu", "noise.cu", "__init__.py"):
        assert f"opt3dgs_optim/cuda/{name}" in names


def test_wheel_steps_in_an_empty_environment(wheel: Path, tmp_path: Path) -> None:
    """An environment with the wheel and, on its path, torch: nothing is downloaded."""
    venv.create(tmp_path / "env", with_pip=False)
    python = tmp_path / "env" / "bin" / "python"
    site = next((tmp_path / "env" / "lib").glob("python*")) / "site-packages"
    install = [sys.executable, "-m", "pip", "install", "--no-deps", "--no-index", "-q"]
    subprocess.run([*install, "--target", str(site), str(wheel)], check=True)
    (site / "torch.pth").write_text(str(Path(torch.__file__).parent.parent) + "\n")
    run = subprocess.run(
        [str(python), "-W", "error", "-c", STEP.format(place=str(site))],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    assert "the kernels need a CUDA device" in run.stdout
