"""Trainers that were edited wrongly once: each has the right edit, or a refusal with its line."""

from __future__ import annotations

from pathlib import Path

import pytest
from trainer_files import GSPLAT, INRIA, added

from opt3dgs_optim.hosts import diff

LOOP = "    for iteration in range(first_iter, opt.iterations + 1):\n"
L1 = "Ll1 = l1_loss(image, gt_image)"
BACKWARD = "        loss.backward()\n"


def lines_for(folder: Path, text: str) -> list[str]:
    return added(edited(folder, text).diff)


def edited(folder: Path, text: str):
    path = folder / "train.py"
    path.write_text(text)
    return diff(path)


def inside(text: str, head: str) -> str:
    """INRIA's trainer with its loop one level deeper, below `head`."""
    before, loop = text.split(LOOP)
    body, after = loop.split("\n\n\ndef ")
    deeper = "".join(f"    {line}\n" for line in (LOOP + body).splitlines())
    return f"{before}    {head}\n{deeper}\n\ndef {after}"


def line_of(text: str, part: str) -> int:
    return text[: text.index(part)].count("\n") + 1


REFUSED = {
    "epochs around the images": (inside(INRIA, "for epoch in range(3):"), "another loop"),
    "a while around the loop": (inside(INRIA, "while not done:"), "another loop"),
    "micro-batches": (
        INRIA.replace(BACKWARD, "        for crop in crops:\n            loss.backward()\n"),
        "several times for one step",
    ),
    "accumulated gradients": (
        INRIA.replace("if iteration < opt.iterations:", "if iteration % 4 == 0:"),
        "only where iteration % 4 == 0",
    ),
    "a condition with a name": (
        INRIA.replace("if iteration < opt.iterations:", "if accelerator.sync_gradients:"),
        "only where accelerator.sync_gradients",
    ),
    "a loop that counts down": (
        INRIA.replace("range(first_iter, opt.iterations + 1)", "range(opt.iterations, 0, -1)"),
        "counts down",
    ),
    "a count of its own": (
        INRIA.replace(BACKWARD, "        iteration += 1\n" + BACKWARD),
        "gets another value",
    ),
    "a total that changes": (
        INRIA.replace("opt.iterations + 1", "total + 1")
        .replace("    first_iter = 0\n", "    first_iter, total = 0, 9\n    b = range(1, total)\n")
        .replace("in range(first_iter, total + 1)", "in b")
        .replace("    first_iter += 1\n", "    first_iter += 1\n    total = 7\n"),
        "total changes here",
    ),
    "a closure": (
        INRIA.replace("gaussians.optimizer.step()", "gaussians.optimizer.step(lambda: loss)"),
        "is no step of an Adam",
    ),
    "a loss without a name": (
        INRIA.replace("loss.backward()", "(loss / 4).backward()"),
        "of a loss with a name",
    ),
    "accelerate": (INRIA.replace("loss.backward()", "accelerator.backward(loss)"), "with a name"),
}  # fmt: skip


@pytest.mark.parametrize("kind", REFUSED)
def test_refused_with_a_line_and_a_reason(tmp_path: Path, kind: str) -> None:
    text, reason = REFUSED[kind]
    assert text != INRIA
    with pytest.raises(ValueError, match=r"^line \d+: ") as refused:
        edited(tmp_path, text)
    assert reason in str(refused.value)


def test_the_line_is_that_of_the_inner_loop(tmp_path: Path) -> None:
    text, _ = REFUSED["epochs around the images"]
    with pytest.raises(ValueError) as refused:
        edited(tmp_path, text)
    inner, outer = line_of(text, "for iteration in"), line_of(text, "for epoch in")
    assert f"line {inner}: " in str(refused.value)
    assert f"(line {outer})" in str(refused.value)


def test_a_start_that_is_not_zero_is_counted(tmp_path: Path) -> None:
    text = GSPLAT.replace("init_step = 0", "init_step = 7000")
    assert "phases.observe(loss, iteration=step)" in lines_for(tmp_path, text)


def test_an_argument_may_be_any_start(tmp_path: Path) -> None:
    text = GSPLAT.replace("        init_step = 0\n", "").replace(
        "def train(self)", "def train(self, init_step=0)"
    )
    assert "phases.observe(loss, iteration=step)" in lines_for(tmp_path, text)


def test_batches_of_a_range_with_three_arguments(tmp_path: Path) -> None:
    """Grendel-GS: the count goes on by the batch."""
    text = INRIA.replace("opt.iterations + 1)", "opt.iterations + 1, opt.bsz)")
    lines = lines_for(tmp_path, text)
    assert "phases = PhaseScheduler(opt.iterations)" in lines
    assert "phases.observe(loss, iteration=iteration - 1)" in lines


def test_a_start_that_may_be_zero_is_never_minus_one(tmp_path: Path) -> None:
    text = INRIA.replace("    first_iter += 1\n", "")
    lines = lines_for(tmp_path, text)
    assert "phases = PhaseScheduler(opt.iterations + 1)" in lines
    assert "phases.observe(loss, iteration=iteration)" in lines


@pytest.mark.parametrize(
    "term",
    [
        "Ll1 = l1_loss(depth, gt_depth)",
        "Ll1 = l1_loss(render_pkg['depth'], gt_depth)",
        "depth_loss = l1_loss(image, gt_image)",
        "Ll1_normal = l1_loss(normal, gt_normal)",
        "anything = l1_loss(image, gt_image)",
    ],
)
def test_another_l1_term_is_not_the_photometric_one(tmp_path: Path, term: str) -> None:
    text = INRIA.replace(L1, f"Ll1 = (image - gt_image).abs().mean()\n        {term}")
    done = edited(tmp_path, text)
    assert "pixel_loss" not in done.diff
    assert any("no L1 = l1_loss" in note for note in done.notes)


def test_a_depth_under_another_name(tmp_path: Path) -> None:
    text = INRIA.replace(L1, f"image = package['depth']\n        {L1}")
    assert "pixel_loss" not in edited(tmp_path, text).diff


def test_a_scheduler_of_the_trainers_own(tmp_path: Path) -> None:
    """The import would have taken its name away."""
    text = INRIA.replace("import torch\n", "import torch\nfrom utils import PhaseScheduler\n")
    text = text.replace("    first_iter += 1\n", "    first_iter += 1\n    PhaseScheduler(opt)\n")
    lines = lines_for(tmp_path, text)
    assert "from opt3dgs_optim import PhaseScheduler as TwoPhaseScheduler" in lines
    assert "phases = TwoPhaseScheduler(opt.iterations)" in lines


def test_a_loop_at_module_level(tmp_path: Path) -> None:
    head, body = INRIA.split("def training(dataset, opt, pipe, checkpoint):\n")
    flat = "\n".join(line.removeprefix("    ") for line in body.split("\n\n\ndef")[0].splitlines())
    text = f"{head}from arguments import opt, dataset, checkpoint\n\n{flat}\n\nimport matplotlib\n"
    lines = lines_for(tmp_path, text)
    assert "phases.observe(loss, iteration=iteration - 1)" in lines
    new = edited(tmp_path, text).new.decode()  # the import stands above the loop
    assert new.index("from opt3dgs_optim") < new.index("PhaseScheduler(") < new.index("for iter")


def test_a_method_called_for_each_epoch(tmp_path: Path) -> None:
    text = (
        GSPLAT + "\n    def fit(self):\n        for epoch in range(3):\n            self.train()\n"
    )
    with pytest.raises(ValueError, match=r"is called in a loop"):
        edited(tmp_path, text)


def test_a_trainer_of_its_own_for_each_scene(tmp_path: Path) -> None:
    text = GSPLAT + "\n\nfor scene in scenes:\n    runner = Runner(scene)\n    runner.train()\n"
    assert "phases.observe(loss, iteration=step)" in lines_for(tmp_path, text)
