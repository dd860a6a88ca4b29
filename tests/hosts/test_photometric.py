"""Only what is certainly the mean absolute error of two photos becomes the scheduler's loss."""

from __future__ import annotations

from pathlib import Path

import pytest
from running_trainers import run
from trainer_files import lines_of, short

from opt3dgs_optim.hosts import diff

PHOTOS = "image, gt_image = render()\n"
LEFT_ALONE = {  # lines above the function, the lines of the loss
    "elementwise": (
        "def l1_loss(a, b):\n    return (a - b).abs()",
        "Ll1 = l1_loss(image, gt_image)\nloss = loss_of() + (Ll1 * 2).mean()",
    ),
    "sum": (
        "def l1_loss(a, b):\n    return torch.abs(a - b).sum()",
        "Ll1 = l1_loss(image, gt_image)\nloss = loss_of() + Ll1",
    ),
    "sum of rows": (
        "def l1_loss(a, b):\n    return torch.abs(a - b).sum(-1)",
        "Ll1 = l1_loss(image, gt_image).mean()\nloss = loss_of() + Ll1",
    ),
    "squares": (
        "def l1_loss(a, b):\n    return ((a - b) ** 2).mean()",
        "Ll1 = l1_loss(image, gt_image)\nloss = loss_of() + Ll1",
    ),
    "without a mean": (
        "l1_loss = torch.nn.L1Loss(reduction='sum')",
        "Ll1 = l1_loss(image, gt_image)\nloss = loss_of() + Ll1",
    ),
    "another's name": (
        "from trainer import l1_map as l1_loss",
        "Ll1 = l1_loss(image, gt_image)\nloss = loss_of() + Ll1",
    ),
    "reduced": ("", "Ll1 = l1_loss(image, gt_image)\nloss = loss_of() + (Ll1 * 2).sum()"),
    "reduced by a function": (
        "",
        "Ll1 = l1_loss(image, gt_image)\nloss = loss_of() + torch.mean(Ll1 * 2)",
    ),
    "reduced later": (
        "",
        "Ll1 = l1_loss(image, gt_image)\nmore = Ll1 * 2\nmore += 1\nloss = loss_of() + more.max()",
    ),
    "indexed": ("", "Ll1 = l1_loss(image, gt_image)\nloss = loss_of() + Ll1[...]"),
    "another axis": (
        "",
        "gt_image = gt_image.detach()[None]\nLl1 = l1_loss(image, gt_image)\n"
        "loss = loss_of() + Ll1",
    ),
    "another axis of the argument": (
        "",
        "Ll1 = l1_loss(image, gt_image.unsqueeze(0))\nloss = loss_of() + Ll1",
    ),
    "depth of a pair": (
        "",
        "pkg = dict(depth=image, real=gt_image)\npred, gt = pkg['depth'], pkg['real']\n"
        "Ll1 = l1_loss(pred, gt)\nloss = loss_of() + Ll1",
    ),
    "for the log": (
        "",
        "with torch.no_grad():\n    Ll1 = l1_loss(image, gt_image)\nloss = loss_of() + Ll1",
    ),
    "in no loss": ("", "Ll1 = l1_loss(image, gt_image)\nprint(Ll1.item())\nloss = loss_of()"),
}


def l1_map(a, b):
    return (a - b).abs().sum()


@pytest.mark.parametrize("kind", LEFT_ALONE)
def test_a_term_that_may_be_another_is_left_alone(tmp_path: Path, kind: str) -> None:
    """The losses are those of the trainer."""
    top, loss = LEFT_ALONE[kind]
    text = short(top=top, loss=PHOTOS + loss + "\nlosses.append(float(loss))")
    assert not [line for line in lines_of(tmp_path, text) if "pixel_loss" in line]
    stock, edited = [], []
    run(text.encode(), losses=stock, l1_map=l1_map)
    run(diff(tmp_path / "train.py").new, losses=edited, l1_map=l1_map)
    assert stock == edited


def test_what_is_logged_below_is_no_reduction(tmp_path: Path) -> None:
    """compact3d and SparseGS subscript what a function has made of the loss."""
    loss = f"{PHOTOS}Ll1 = l1_loss(image, gt_image)\nloss = loss_of() + Ll1"
    step = (
        "shown = dict(all=Ll1.item(), loss=loss)\nprint(shown['loss'])\ngaussians.optimizer.step()"
    )
    text = short(loss=loss, step=step)
    assert "Ll1 = phases.pixel_loss(image, gt_image)" in lines_of(tmp_path, text)


def test_a_mask_says_nothing_of_what_it_picks(tmp_path: Path) -> None:
    """Gaussian-Wild's mask is called as the features of a network that makes it."""
    loss = (
        f"{PHOTOS}features_mask = image > 0\n"
        "if iteration > 2:\n    Ll1 = l1_loss(image * features_mask, gt_image * features_mask)\n"
        "else:\n    Ll1 = l1_loss(image, gt_image)\nloss = loss_of() + Ll1"
    )
    found = [line for line in lines_of(tmp_path, short(loss=loss)) if "pixel_loss" in line]
    assert len(found) == 2
    depth = loss.replace("image * features_mask, gt_image", "depth * features_mask, gt_image")
    depth = depth.replace("features_mask = ", "depth = image\nfeatures_mask = ")
    found = [line for line in lines_of(tmp_path, short(loss=depth)) if "pixel_loss" in line]
    assert len(found) == 1


@pytest.mark.parametrize(
    ("top", "term"),
    [
        ("", "l1_loss(image, gt_image)"),
        ("", "l1_loss(image[None], gt_image[None])"),
        ("from trainer import l1_loss", "l1_loss(image, gt_image)"),
        ("def l1_loss(a, b):\n    return torch.abs(a - b).mean()", "l1_loss(image, gt_image)"),
        ("def l1_loss(a, b):\n    return (a - b).abs()", "l1_loss(image, gt_image).mean()"),
    ],
)
def test_a_mean_is_replaced(tmp_path: Path, top: str, term: str) -> None:
    images = term[term.index("(") : term.index(")") + 1]
    loss = f"{PHOTOS}Ll1 = {term}\nloss = loss_of() + Ll1\nprint(Ll1.item())"
    assert f"Ll1 = phases.pixel_loss{images}" in lines_of(tmp_path, short(top=top, loss=loss))


def test_another_term_of_two_photos_is_named(tmp_path: Path) -> None:
    """GS-IR's second stage trains on a term of another name."""
    loss = (
        f"{PHOTOS}Ll1 = l1_loss(image, gt_image)\nif iteration < 2:\n    loss = loss_of() + Ll1\n"
        "else:\n    pbr_loss = l1_loss(image, gt_image)\n    loss = loss_of() + pbr_loss"
    )
    path = tmp_path / "train.py"
    path.write_text(short(loss=loss))
    line = 1 + path.read_text().splitlines().index(
        "            pbr_loss = l1_loss(image, gt_image)"
    )
    (note,) = diff(path).notes
    assert note.startswith(f"l1_loss of two photos stays as it is in line {line},")
