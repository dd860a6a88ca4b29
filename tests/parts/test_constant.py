"""The control of the histogram: a constant factor while exploring."""

from __future__ import annotations

from trainers import only

from opt3dgs_optim import ConstantMultiplier


def test_it_is_one_during_the_warm_up() -> None:
    phases = only(30, ConstantMultiplier(2.5, warmup=2))
    part = phases.part(ConstantMultiplier)
    assert part is not None
    seen = []
    for _ in range(4):
        phases.observe(0.1)
        seen.append((part.factor({}, phases), dict(part.numbers(phases))))
    assert seen == [(1.0, {}), (1.0, {}), (2.5, {"nu": 2.5}), (2.5, {"nu": 2.5})]
