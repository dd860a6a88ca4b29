"""A trainer of either family that edits rows in every known way, and a twin of every row.

A twin is one point alone, in optimizers of its own that nobody edits: it says where the row should
be. Everything is float64, so that rounding in vectors of another length stays at 1e-15.
"""

from __future__ import annotations

import io
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter
from trainers import everything

from opt3dgs_optim import ConstantMultiplier, Curvature, PhaseScheduler
from opt3dgs_optim.state import ParameterRecord

TOTAL, SWITCH = 400, 8
RATES = {"means": 1e-2, "opacities": 5e-2}
INRIA = {"means": "xyz", "opacities": "opacity"}
MOMENTS = ("exp_avg", "exp_avg_sq")
PAIRS = "Curvature.history"


def make_phases() -> PhaseScheduler:
    return everything(TOTAL, SWITCH, nu=ConstantMultiplier(1.5), curvature=Curvature(3))


def build(kind: str, splats: dict[str, Parameter]) -> Any:
    """The stock optimizers of a gsplat-like or INRIA-like trainer."""
    if kind == "gsplat":
        return {
            name: torch.optim.Adam([{"params": p, "lr": RATES[name], "name": name}], eps=1e-15)
            for name, p in splats.items()
        }
    groups = [{"params": [p], "lr": RATES[n], "name": INRIA[n]} for n, p in splats.items()]
    return torch.optim.Adam(groups, lr=0.0, eps=1e-15)


def slope(name: str, value: Tensor) -> Tensor:
    """Gradient of every row in that row, stiff on the positions."""
    if name == "means":
        return value * torch.tensor([1.0, 7.0, 30.0], dtype=torch.float64) + 0.1
    return 2 * value - 1


class Splats:
    """Parameters, upgraded optimizers, and one step of them."""

    def __init__(self, kind: str, values: dict[str, Tensor], phases: PhaseScheduler) -> None:
        self.kind = kind
        self.params = {name: Parameter(value.clone()) for name, value in values.items()}
        self.optimizers: Any = phases.upgrade(build(kind, self.params))

    def optimizer(self, name: str) -> Any:
        return self.optimizers[name] if self.kind == "gsplat" else self.optimizers

    def every(self) -> list[Any]:
        return list(self.optimizers.values()) if self.kind == "gsplat" else [self.optimizers]

    def state(self, name: str) -> dict[str, Tensor]:
        return self.optimizer(name).state[self.params[name]]

    def group(self, name: str) -> dict[str, Any]:
        groups = self.optimizer(name).param_groups
        return groups[0 if self.kind == "gsplat" else list(self.params).index(name)]

    def record(self, name: str) -> ParameterRecord:
        """What its optimizer knows of a parameter, whichever object it is."""
        number = 0 if self.kind == "gsplat" else list(self.params).index(name)
        return self.optimizer(name)._records[number][0]

    def step(self, weights: Tensor, mask: Tensor | None) -> None:
        """Gradients times `weights` [N] (0 unseen, NaN broken), then every optimizer's step."""
        for name, param in self.params.items():
            rows = weights.reshape(-1, *[1] * (param.dim() - 1))
            found = slope(name, param.detach()) * rows
            param.grad = torch.where(rows == 0, 0.0, found)
        for optimizer in self.every():
            optimizer.step() if mask is None else optimizer.step(visible=mask)
            optimizer.zero_grad(set_to_none=True)


class HostileTrainer:
    """The trainer, its twins, and what it does between two calls."""

    def __init__(self, kind: str, rows: int) -> None:
        self.kind, self.iteration = kind, 0
        self.generator = torch.Generator().manual_seed(rows)
        self.phases, self.twin_phases = make_phases(), make_phases()
        self.ours = Splats(kind, self.random(rows), self.phases)
        values = self.ours.params
        self.twins = [self.twin({n: v[i : i + 1] for n, v in values.items()}) for i in range(rows)]

    def random(self, rows: int) -> dict[str, Tensor]:
        shapes = {"means": (rows, 3), "opacities": (rows,)}
        like = {"generator": self.generator, "dtype": torch.float64}
        return {name: torch.randn(shape, **like) for name, shape in shapes.items()}

    def twin(self, values: dict[str, Tensor]) -> Splats:
        return Splats(self.kind, {n: v.detach() for n, v in values.items()}, self.twin_phases)

    def __len__(self) -> int:
        return len(self.twins)

    # -- iterations ------------------------------------------------------------------------------

    def observe(self, loss: float) -> None:
        self.phases.observe(loss, iteration=self.iteration)
        self.twin_phases.observe(loss, iteration=self.iteration)
        self.iteration += 1

    def step(self, weights: list[float], *, masked: bool, loss: float = 0.1) -> None:
        """One iteration; with `masked`, the rows of weight 0 are left out of the step itself."""
        rows = torch.tensor(weights, dtype=torch.float64)
        mask = rows != 0 if masked else None
        self.observe(loss)
        self.ours.step(rows, mask)
        for i, twin in enumerate(self.twins):
            twin.step(rows[i : i + 1], None if mask is None else mask[i : i + 1])

    def no_gradient(self) -> None:
        """INRIA's iterations that edit points: new Parameters have no gradient yet."""
        self.observe(0.1)
        for splats in (self.ours, *self.twins):
            for optimizer in splats.every():
                optimizer.step()

    def noise(self) -> None:
        """3DGS-MCMC's noise, after the step and in place."""
        for i, twin in enumerate(self.twins):
            move = 0.01 * torch.randn(3, generator=self.generator, dtype=torch.float64)
            with torch.no_grad():
                self.ours.params["means"][i] += move
                twin.params["means"][0] += move

    # -- edits -----------------------------------------------------------------------------------

    def replace(
        self,
        keep: list[int],
        added: dict[str, Tensor],
        *,
        zeroed: Iterable[int] = (),
        only: str | None = None,
    ) -> None:
        """New Parameters of the rows `keep` and `added`; the state as this family edits it.

        Args:
            keep: rows to keep, in their new order.
            added: values of new rows, which have zero state.
            zeroed: rows (as kept) whose state is set to zero, as relocation does.
            only: edit this parameter only (a reset of the opacities).
        """
        many = len(next(iter(added.values()))) if added else 0
        for name in [only] if only else list(self.ours.params):
            self.exchange(name, keep, added.get(name), many, list(zeroed))
        if only is None:
            self.twins = [self.twins[i] for i in keep]
            self.twins += [
                self.twin({n: v[i : i + 1] for n, v in added.items()}) for i in range(many)
            ]
        for name in [only] if only else list(self.ours.params):
            for i, twin in enumerate(self.twins):
                self.follow(name, twin, new=i >= len(keep), zeroed=i in set(zeroed))

    def exchange(
        self, name: str, keep: list[int], added: Tensor | None, many: int, zeroed: list[int]
    ) -> None:
        old, optimizer = self.ours.params[name], self.ours.optimizer(name)
        parts = [old.detach()[keep]] + ([] if added is None else [added])
        fresh = Parameter(torch.cat(parts))
        state = optimizer.state.pop(old, None)
        if state is not None:
            keys = MOMENTS if self.kind == "inria" else [k for k in state if k != "step"]
            for key in keys:
                rows = state[key][keep]
                rows[zeroed] = 0
                state[key] = torch.cat([rows, torch.zeros(many, *rows.shape[1:])]).to(rows.dtype)
            optimizer.state[fresh] = state
        self.ours.group(name)["params"] = [fresh]
        self.ours.params[name] = fresh

    def follow(self, name: str, twin: Splats, *, new: bool, zeroed: bool) -> None:
        """What the edit means for one row: its pairs are gone, and the moments where they are 0."""
        optimizer, param = twin.optimizer(name), twin.params[name]
        mine, its = self.ours.record(name), twin.record(name)
        its.last_step = mine.last_step
        twin.optimizer(name)._open_windows = dict(self.ours.optimizer(name)._open_windows)
        its.numbers = {key: value.clone() for key, value in mine.numbers.items()}
        ours = self.ours.optimizer(name).state.get(self.ours.params[name])
        if ours is None:
            return
        state = optimizer.state[param]
        if new:
            state.update({k: torch.zeros_like(param) for k in MOMENTS})
            state["step"] = ours["step"].clone()
        if zeroed:
            for key in MOMENTS:
                state[key].zero_()
        state.pop(PAIRS, None)

    def zero_row(self, row: int) -> None:
        """Relocation in place: all that is kept of a row is zeroed, and the Parameters stay."""
        for name, param in self.ours.params.items():
            twin = self.twins[row]
            alone = twin.optimizer(name).state.get(twin.params[name], {})
            alone.pop(PAIRS, None)
            for state, at in ((self.ours.optimizer(name).state.get(param, {}), row), (alone, 0)):
                for key in set(state) - {"step"}:
                    state[key][at] = 0

    # -- checkpoints -----------------------------------------------------------------------------

    def resume(self, *, load_first: bool) -> None:
        """Save, forget everything, load: before or after the upgrade."""
        buffer = io.BytesIO()
        ours = self.ours
        states = [optimizer.state_dict() for optimizer in ours.every()]
        values = {name: param.detach() for name, param in ours.params.items()}
        torch.save([values, states], buffer)
        buffer.seek(0)
        values, states = torch.load(buffer, weights_only=True)
        self.phases = make_phases()
        if load_first:
            params = {name: Parameter(value) for name, value in values.items()}
            stock = build(self.kind, params)
            every = list(stock.values()) if self.kind == "gsplat" else [stock]
            for optimizer, state in zip(every, states, strict=True):
                optimizer.load_state_dict(state)
            ours.params, ours.optimizers = params, self.phases.upgrade(stock)
        else:
            self.ours = Splats(self.kind, values, self.phases)
            for optimizer, state in zip(self.ours.every(), states, strict=True):
                optimizer.load_state_dict(state)
        assert self.phases.iteration == self.iteration

    # -- what must hold --------------------------------------------------------------------------

    def difference(self, rows: slice = slice(None)) -> float:
        """The largest distance of any of the rows from its twin, relative to 1 or its size."""
        worst = 0.0
        for name, param in self.ours.params.items():
            alone = torch.cat([twin.params[name].detach() for twin in self.twins])
            error = (param.detach() - alone).abs() / alone.abs().clamp(min=1)
            worst = max(worst, float(error[rows].max()))
            assert bool(torch.isfinite(param).all())
        return worst
