"""The control of the histogram: a constant factor while exploring."""

from __future__ import annotations

import torch
from trainers import gsplat_optimizers, make_splats, only, train

from opt3dgs_optim import ConstantMultiplier


def test_it_is_a_larger_learning_rate_while_exploring() -> None:
    ours, theirs = make_splats(), make_splats()
    phases = only(30, ConstantMultiplier(2.0), switch=20)
    optimizers, plain = phases.upgrade(gsplat_optimizers(ours)), gsplat_optimizers(theirs)
    for iteration in range(30):
        for name, optimizer in plain.items():
            rate = optimizers[name].param_groups[0]["lr"]
            optimizer.param_groups[0]["lr"] = rate * (2.0 if iteration < 20 else 1.0)
        train(ours, optimizers, phases, iteration, iteration + 1)
        train(theirs, plain, None, iteration, iteration + 1)
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)


def test_it_is_one_during_the_warm_up() -> None:
    phases = only(30, ConstantMultiplier(2.5, warmup=2))
    part = phases.part(ConstantMultiplier)
    assert part is not None
    seen = []
    for _ in range(4):
        phases.observe(0.1)
        seen.append((part.factor({}, phases), dict(part.numbers(phases))))
    assert seen == [(1.0, {}), (1.0, {}), (2.5, {"nu": 2.5}), (2.5, {"nu": 2.5})]
