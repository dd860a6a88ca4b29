"""Writes the checkpoints that later versions must still load.

    python tests/support/landed_checkpoints.py FOLDER

Format 2 (tests/data/format_2_*.pt) was written so at commit ee0d4c4, the last one of that format.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import torch
from placed_training import Training

from opt3dgs_optim import AWSGLD, EnergyHistogram, LQNAdam

AT = {"DEFAULTS": 89, "paper": 66, "everything": 40, "EnergyHistogram": 30}  # arm -> iteration
STEPS, MORE = 12, 8


def training(arm: str) -> dict[str, Any]:
    """A training's checkpoint, and where it ended."""
    first = Training(arm, layout="single").run(AT[arm])
    saved = {"iteration": AT[arm], "values": first.values(), "random": torch.get_rng_state()}
    saved = torch.load(_kept({**saved, "optimizer": first.optimizers.state_dict()}))
    return {**saved, "end": first.run().values()}


def own(kind: str) -> tuple[Any, Any]:
    """A parameter in an optimizer of its own."""
    x = torch.nn.Parameter(torch.linspace(-1, 1, 12).reshape(4, 3))
    if kind == "LQNAdam":
        return x, LQNAdam([x], lr=0.01)
    return x, AWSGLD([x], lr=0.01, histogram=EnergyHistogram(warmup=4))


def step_own(x: Any, optimizer: Any, steps: int) -> None:
    scale = torch.tensor([1.0, 3.0, 9.0])
    for _ in range(steps):
        loss = (x**2 * scale).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step(lambda loss=loss: loss.detach())


def optimizer(kind: str) -> dict[str, Any]:
    """The checkpoint of an optimizer of ours, and where it ended."""
    x, ours = own(kind)
    step_own(x, ours, STEPS)
    saved = {"value": x.detach().clone(), "optimizer": ours.state_dict()}
    saved = torch.load(_kept(saved), weights_only=True)
    step_own(x, ours, MORE)
    return {**saved, "end": x.detach().clone()}


def _kept(saved: Any) -> Any:
    import io

    buffer = io.BytesIO()
    torch.save(saved, buffer)
    buffer.seek(0)
    return buffer


def main() -> None:
    folder = Path(sys.argv[1])
    for arm in AT:
        torch.save(training(arm), folder / f"format_2_{arm}.pt")
    for kind in ("LQNAdam", "AWSGLD"):
        torch.save(optimizer(kind), folder / f"format_2_{kind}.pt")


if __name__ == "__main__":
    main()
