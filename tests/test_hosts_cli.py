"""`python -m opt3dgs_optim.hosts diff`: at most four lines, on files with the trainers' anchors."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from gsplat_host import HOSTS as FOLDER

from opt3dgs_optim.hosts import diff, main, write

# The anchors of the real files, in their order and indentation, and nothing else of them.
GSPLAT = """\
import torch
from gsplat.strategy import DefaultStrategy, MCMCStrategy


class Runner:
    def __init__(self, local_rank, world_rank, world_size, cfg):
        self.splats, self.optimizers = create_splats_with_optimizers(
            self.parser,
            batch_size=cfg.batch_size,
        )

    def train(self):
        cfg = self.cfg
        max_steps = cfg.max_steps
        for step in range(max_steps):
            l1loss = F.l1_loss(colors, pixels)
            loss = l1loss
            loss.backward()

    def eval(self, step):
        max_steps = 1
"""
GSPLAT_16 = GSPLAT.replace(
    "            l1loss = F.l1_loss(colors, pixels)\n",
    """\
            if masks is not None:
                l1loss = l1_loss(colors[masks], pixels[masks]).mean()
            else:
                l1loss = l1_loss(colors, pixels).mean()
""",
)
INRIA = """\
from scene import Scene, GaussianModel


def training(dataset, opt, pipe, checkpoint):
    gaussians.training_setup(opt)
    if checkpoint:
        gaussians.restore(model_params, opt)

    bg_color = [1, 1, 1] if dataset.white_background else [0, 0, 0]
    for iteration in range(first_iter, opt.iterations + 1):
        Ll1 = l1_loss(image, gt_image)
        loss = (1.0 - opt.lambda_dssim) * Ll1
        loss.backward()


def training_report(l1_loss):
    l1_test += l1_loss(image, gt_image)
"""
SYNTHETIC = {"gsplat": GSPLAT, "gsplat 1.6": GSPLAT_16, "inria": INRIA}
REAL = [
    "gsplat-1.5.3/examples/simple_trainer.py",
    "gsplat-main/examples/simple_trainer.py",
    "3dgs-mcmc/train.py",
    "gaussian-splatting/train.py",
    "taming-3dgs/train.py",
    "speedy-splat/train.py",
]


def added(lines: str) -> list[str]:
    return [line[1:].strip() for line in lines.splitlines() if re.match(r"\+(?!\+\+)", line)]


def check(path: Path) -> list[str]:
    """At most four lines, and the result is a Python file in which they stand in order."""
    before = path.read_text()
    lines = added(diff(path)[1])
    assert len(lines) <= 4
    assert lines[0] == "from opt3dgs_optim import PhaseScheduler"
    assert "PhaseScheduler.install(" in lines[1]
    assert "pixel_loss" in lines[2]
    assert "observe(loss)" in lines[3]
    backup = write(path)
    assert backup.read_text() == before
    assert backup.name == path.name + ".orig"
    after = path.read_text()
    compile(after, str(path), "exec")
    changed = sum(line not in before.splitlines() for line in after.splitlines())
    assert changed == len(lines)
    return lines


@pytest.mark.parametrize("kind", SYNTHETIC)
def test_lines_for_files_with_the_anchors(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "trainer.py"
    path.write_text(SYNTHETIC[kind])
    lines = check(path)
    text = path.read_text()
    if kind == "inria":
        # after restore(), which makes a new optimizer
        assert text.index("restore(") < text.index(lines[1]) < text.index("for iteration")
        assert "l1_test += l1_loss(" in text
    else:
        assert text.index(")\n        " + lines[1]) < text.index("def train")


@pytest.mark.parametrize("name", REAL)
def test_lines_for_the_real_files(tmp_path: Path, name: str) -> None:
    if not (FOLDER / name).is_file():
        pytest.skip(f"no {FOLDER / name}: put the upstream file there, or set OPT3DGS_HOSTS")
    path = tmp_path / Path(name).name
    path.write_bytes((FOLDER / name).read_bytes())
    check(path)


def test_windows_line_ends_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "train.py"
    path.write_bytes(INRIA.replace("\n", "\r\n").encode())
    write(path)
    data = path.read_bytes()
    assert data.count(b"\n") == data.count(b"\r\n") == INRIA.count("\n") + 3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("print('hello')\n", "no trainer known here"),
        (INRIA.replace("Ll1 =", "L1 ="), r"Ll1 = l1_loss\(...\) \(0 times\)"),
        (INRIA + "    loss.backward()\n", r"loss.backward\(\) \(2 times\)"),
        (GSPLAT.replace("F.l1_loss", "F.mse_loss"), r"l1loss = F.l1_loss\(...\) \(0 times\)"),
    ],
)
def test_other_files_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture, text: str, message: str
) -> None:
    path = tmp_path / "train.py"
    path.write_text(text)
    assert main(["diff", str(path), "--write"]) == 1
    assert re.search(message, capsys.readouterr().err)
    assert path.read_text() == text
    assert not (tmp_path / "train.py.orig").exists()


def test_a_second_time_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    path = tmp_path / "train.py"
    path.write_text(INRIA)
    assert main(["diff", str(path), "--write"]) == 0
    assert "train.py.orig" in capsys.readouterr().out
    once = path.read_text()
    assert main(["diff", str(path)]) == 1
    assert "imports opt3dgs_optim already" in capsys.readouterr().err
    path.write_text(INRIA)  # the user's own file again, the backup still there
    assert main(["diff", str(path), "--write"]) == 1
    assert "exists already" in capsys.readouterr().err
    assert path.read_text() == INRIA != once
    assert main(["diff", str(tmp_path / "none.py")]) == 1
    assert "cannot be read" in capsys.readouterr().err


def test_as_a_module_it_prints_the_lines(tmp_path: Path) -> None:
    path = tmp_path / "train.py"
    path.write_text(INRIA)
    command = [sys.executable, "-m", "opt3dgs_optim.hosts", "diff", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert len(added(done.stdout)) == 4
    assert path.read_text() == INRIA
