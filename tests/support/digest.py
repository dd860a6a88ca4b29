"""One number for what the package computes: the digest of 200 random trainings, bit for bit.

    python tests/support/digest.py            (the digest, and with --cases one line a training)

A change that moves code leaves it as it is. It depends on torch and on the processor, so that it is
no test: run it before and after, on one machine. A training has random parts, one optimizer or six,
edits of rows in gsplat's way or INRIA's, and perhaps a checkpoint that another one resumes.
"""

from __future__ import annotations

import argparse
import copy
import hashlib
import random
import sys
import warnings
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

import torch
from gaussians import adam_of, adams_of, decayed, parameters, through_a_file
from masked_adams import SelectiveAdam, SparseGaussianAdam, masked
from row_edits import added, apply, forgotten, relocated, removed
from torch import Tensor
from torch.optim import Adam, AdamW

import opt3dgs_optim as package

TRAININGS, ROWS = 200, 40


def parts_of(draw: random.Random) -> list[Any] | None:
    """None for the defaults, or some parts."""
    kind = draw.randrange(4)
    if kind == 0:
        return None
    if kind == 1:
        return [package.Fading(stop=0.5), package.OutOfView(), package.Averaging()]
    if kind == 2:
        return package.paper_parts(draw.choice([40, 3_000]))
    choices: list[Any] = [
        package.Averaging(),
        package.EnergyHistogram(),
        package.Fading(share=0.5, events=draw.choice([3, 30])),
        package.FreshMoments(),
        package.OutOfView(),
        package.PositionNoise(),
        package.SquaredLoss(),
        draw.choice([package.OwnFrame(), package.Curvature(draw.choice([1, 5]))]),
    ]
    return [part for part in choices if draw.random() < 0.5]


def edit_of(draw: random.Random, rows: int) -> Any:
    """An edit of some rows."""
    chosen = torch.tensor(sorted(draw.sample(range(rows), 4)))
    kind = draw.randrange(4)
    if kind == 0:
        return added(chosen)
    if kind == 1:
        return removed(chosen[:2])
    return relocated(chosen[:2], chosen[2:]) if kind == 2 else forgotten()


def train(number: int) -> str:
    """The digest of one random training."""
    draw = random.Random(number)
    torch.manual_seed(number)
    total, moments, one = draw.choice([60, 90]), draw.choice([32, 32, 16]), draw.random() < 0.5
    kinds = [Adam, Adam, AdamW] if moments == 16 else [Adam, AdamW, SelectiveAdam]
    kind = draw.choice([*kinds, SparseGaussianAdam] if moments == 32 else kinds)
    options = {"weight_decay": 0.1} if kind in (Adam, AdamW) and draw.random() < 0.3 else {}
    params, parts = parameters(ROWS, seed=number), parts_of(draw)
    make = adam_of if one else adams_of

    def made() -> tuple[Any, list[Any]]:
        optimizers = make(params, kind, **options)
        phases = package.PhaseScheduler(
            total,
            switch=draw.choice([0.5, 29 / 30]),
            parts=copy.deepcopy(parts),
            moments=moments,  # pyright: ignore
        )
        phases.upgrade(optimizers)
        return phases, [optimizers] if one else list(optimizers.values())

    edits = draw.random() < 0.6
    again = draw.randrange(total) if draw.random() < 0.4 else None
    inria = draw.random() < 0.5
    phases, optimizers = made()
    generator = torch.Generator().manual_seed(number)
    for iteration in range(total):
        count = len(params["means"])
        visible = torch.rand(count, generator=generator) < 0.7
        for param in params.values():
            grad = torch.randn(param.shape, generator=generator)
            grad[~visible] = 0.0
            param.grad = grad * 10.0 ** draw.uniform(-3, 0)
        phases.observe(torch.rand((), generator=generator) * 0.2)
        rates = decayed(iteration, total)
        for optimizer in optimizers:
            for group, (_, name) in zip(optimizer.param_groups, optimizer._slots, strict=True):
                group["lr"] = rates[name]
            given: Any = () if kind in (Adam, AdamW) else masked(kind, visible)  # pyright: ignore
            optimizer.step(*given)
        if edits and iteration % 7 == 6 and iteration < 0.8 * total and draw.random() < 0.7:
            names = ["opacities"] if draw.random() < 0.2 else list(params)
            edit = edit_of(draw, count) if len(names) > 1 else forgotten()
            apply(edit, params, optimizers, names, inria and len(names) > 1)
        if iteration == again:
            saved = through_a_file([each.state_dict() for each in optimizers])
            phases, optimizers = made()
            for optimizer, state in zip(optimizers, saved, strict=True):
                optimizer.load_state_dict(state)
    phases.finish()
    digest = hashlib.sha256()
    for optimizer in optimizers:
        for group in optimizer.param_groups:
            take(digest, group["params"][0])
            for key, value in sorted(optimizer.state[group["params"][0]].items()):
                digest.update(key.encode())
                take(digest, value)
    return digest.hexdigest()[:12]


def take(digest: Any, value: Tensor) -> None:
    digest.update(str((value.dtype, tuple(value.shape))).encode())
    digest.update(value.detach().contiguous().numpy().tobytes())


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--cases", action="store_true", help="one line a training, too")
    shown = parser.parse_args().cases
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    digest = hashlib.sha256()
    for number in range(TRAININGS):
        try:
            found = train(number)
        except (TypeError, ValueError) as error:  # refused: that is a result, too
            found = f"refused: {error}"
        digest.update(found.encode())
        if shown:
            print(number, found)
    print(digest.hexdigest())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
