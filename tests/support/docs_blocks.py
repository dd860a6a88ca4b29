"""The fenced blocks of a Markdown page, and what an excerpt of a trainer needs to run."""

from __future__ import annotations

import os
import re
import tempfile
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
FENCE = re.compile(
    r"^(?P<indent> *)```(?P<language>\w*) *(?:title=\"(?P<title>[^\"]*)\")?[^\n]*\n"
    r"(?P<text>.*?)^(?P=indent)```[ \t]*$",
    re.M | re.S,
)


@dataclass(frozen=True)
class Block:
    """One fenced block."""

    language: str
    title: str  # a path: an excerpt of it; "prints": what the block before it prints
    text: str
    line: int  # of the fence, from 1


def pages() -> list[Path]:
    """The READMEs, CONTRIBUTING and the pages of docs/ that people write (not tables of runs)."""
    written = [p for p in DOCS.rglob("*.md") if "results" not in p.parts]
    readmes = [
        ROOT / "README.md",
        ROOT / "CONTRIBUTING.md",
        *(ROOT / "examples").rglob("README.md"),
    ]
    return [*readmes, *sorted(written)]


def name(page: Path) -> str:
    """The page's path in the repository."""
    return page.relative_to(ROOT).as_posix()


def blocks(page: Path, *languages: str) -> list[Block]:
    """The page's fenced blocks, of those languages or of all."""
    text = page.read_text(encoding="utf-8")
    found = [
        Block(m["language"], m["title"] or "", m["text"], text.count("\n", 0, m.start()) + 1)
        for m in FENCE.finditer(text)
    ]
    return [b for b in found if not languages or b.language in languages]


def unfenced(text: str) -> str:
    """A page without its fenced blocks and inline code, in which links and pictures are looked for.

    Fences keep their number of lines.
    """
    text = FENCE.sub(lambda m: "\n" * m[0].count("\n"), text)
    return re.sub(r"`[^`\n]*`", "", text)


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub and mkdocs make them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
    headings = re.findall(r"^#{1,6} +(.+?) *$", text, re.M)
    slugs = (re.sub(r"[^\w\s-]", "", heading.lower()) for heading in headings)
    return {re.sub(r"[\s]+", "-", slug.strip()) for slug in slugs}


def adams(names: dict[str, int]) -> dict[str, torch.optim.Adam]:
    """One Adam per parameter, of that many columns."""
    return {
        name: torch.optim.Adam(
            [{"params": torch.nn.Parameter(torch.ones(4, columns)), "lr": 1e-3, "name": name}],
            eps=1e-15,
        )
        for name, columns in names.items()
    }


def trainer_names() -> dict[str, Any]:
    """What the excerpts of gsplat's and INRIA's trainers find around them."""
    names = {"xyz": 3, "scaling": 3, "rotation": 4, "opacity": 1}
    groups = [o.param_groups[0] for o in adams(names).values()]
    image = torch.rand(3, 8, 8, requires_grad=True)
    # What the trainers say before the line that is shown.
    loss = image.square().mean()
    loss.backward()
    dict_of_adams = adams({"means": 3, "scales": 3, "quats": 4})
    one_adam = torch.optim.Adam(groups, lr=0.0, eps=1e-15)
    one_adam._optimizers = adams({"means": 3, "scales": 3})  # type: ignore[attr-defined]  # fVDB's
    trainer = SimpleNamespace(
        optimizers=dict_of_adams,
        cfg=SimpleNamespace(strategy={}),
        scene=SimpleNamespace(on_remove=print),  # told of row edits, as gsplat's
        splats=torch.nn.ParameterDict(
            {name: o.param_groups[0]["params"][0] for name, o in dict_of_adams.items()}
        ),
        strategy_state={},
        config=SimpleNamespace(crops_per_image=1),
        model=SimpleNamespace(optimizer=adams({"positions": 3})["positions"]),
        trainer=SimpleNamespace(max_steps=100),
        gaussian_optimizers=[*adams({"means": 3, "shs_dc": 3}).values()],
        optimizer=one_adam,
        num_iters=100,
        step=0,
        _global_step=0,
    )
    strategy = SimpleNamespace(method="GSStrategy")
    return {
        "torch": torch,
        "os": os,
        "self": trainer,
        "conf": SimpleNamespace(n_iterations=100, strategy=strategy),
        "opt_args": SimpleNamespace(iterations=100),
        "total_steps": 100,
        "optimizers": dict_of_adams,
        "global_step": 1,
        "PATH": Path(tempfile.mkdtemp()) / "training.pt",
        "device": "cpu",
        "loss": loss,
        "loss_sum": loss,
        "total_loss": loss,
        "batch_losses": {"total_loss": loss},
        "metrics": {"loss": loss},
        "rgb_pred": image,
        "rgb_gt": torch.rand(3, 8, 8),
        "DefaultStrategy": dict,
        "cfg": SimpleNamespace(max_steps=100),
        "max_steps": 100,
        "world_size": 1,
        "masks": torch.ones(3, 8, 8, dtype=torch.bool),
        "iteration": 1,
        "step": 0,
        "gaussians": SimpleNamespace(
            optimizer=torch.optim.Adam(
                [o.param_groups[0] for o in adams(names).values()], lr=0.0, eps=1e-15
            ),
            shoptimizer=None,
        ),
        "opt": SimpleNamespace(iterations=100),
        "colors": image,
        "pixels": torch.rand(3, 8, 8),
        "image": image,
        "gt_image": torch.rand(3, 8, 8),
    }
