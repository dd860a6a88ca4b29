"""A simulator of the INRIA family's GaussianModel, and of its row edits.

It keeps the contract of the originals: one Adam with six named groups of one parameter, `exp_avg`
and `exp_avg_sq` edited and nothing else, a new Parameter after every edit.
"""

from __future__ import annotations

from argparse import Namespace
from typing import Any

import torch
from splatting.relocation import relocated_values
from torch import Tensor
from torch.nn import Parameter

OPTIONS = Namespace(
    percent_dense=0.01,
    position_lr_init=1e-2,
    position_lr_final=1e-4,
    position_lr_delay_mult=0.01,
    position_lr_max_steps=60,
    feature_lr=2.5e-3,
    opacity_lr=5e-2,
    scaling_lr=5e-3,
    rotation_lr=1e-3,
)
ATTRIBUTES = {
    "xyz": "_xyz",
    "f_dc": "_features_dc",
    "f_rest": "_features_rest",
    "opacity": "_opacity",
    "scaling": "_scaling",
    "rotation": "_rotation",
}


class SimulatedModel:
    """What a trainer of the INRIA family calls, with that family's edits of the optimizer."""

    _xyz: Parameter
    _opacity: Parameter
    _scaling: Parameter

    def __init__(self, sh_degree: int = 3) -> None:
        self.optimizer: Any = None
        self.spatial_lr_scale = 1.0

    def training_setup(self, options: Namespace) -> None:
        """Build the optimizer: six named groups."""
        o = options
        rates = {
            "xyz": o.position_lr_init * self.spatial_lr_scale,
            "f_dc": o.feature_lr,
            "f_rest": o.feature_lr / 20,
            "opacity": o.opacity_lr,
            "scaling": o.scaling_lr,
            "rotation": o.rotation_lr,
        }
        groups = [
            {"params": [getattr(self, ATTRIBUTES[name])], "lr": lr, "name": name}
            for name, lr in rates.items()
        ]
        self.optimizer = torch.optim.Adam(groups, lr=0.0, eps=1e-15)
        self._options = options

    def update_learning_rate(self, iteration: int) -> float:
        """Write the decayed learning rate of the positions into its group."""
        o, t = self._options, min(iteration / self._options.position_lr_max_steps, 1)
        lr = o.position_lr_init ** (1 - t) * o.position_lr_final**t
        next(g for g in self.optimizer.param_groups if g["name"] == "xyz")["lr"] = lr
        return lr

    def capture(self) -> tuple:
        """The checkpoint's tuple."""
        tensors = [getattr(self, attribute) for attribute in ATTRIBUTES.values()]
        return (*tensors, self.optimizer.state_dict(), self.spatial_lr_scale)

    def restore(self, captured: tuple, options: Namespace) -> None:
        """Take a checkpoint: a new optimizer, then its state."""
        *tensors, state, self.spatial_lr_scale = captured
        for attribute, tensor in zip(ATTRIBUTES.values(), tensors, strict=True):
            setattr(self, attribute, tensor)
        self.training_setup(options)
        self.optimizer.load_state_dict(state)

    @property
    def get_opacity(self) -> Tensor:
        """[N, 1], 0..1."""
        return torch.sigmoid(self._opacity)

    @property
    def get_scaling(self) -> Tensor:
        """[N, 3], world units."""
        return torch.exp(self._scaling)

    def _exchange(self, group: dict, value: Tensor, edit: Any) -> None:
        old = group["params"][0]
        state = self.optimizer.state.get(old, None)
        new = Parameter(value.detach().requires_grad_(True))
        if state is not None:
            for key in ("exp_avg", "exp_avg_sq"):
                state[key] = edit(state[key])
            del self.optimizer.state[old]
            self.optimizer.state[new] = state
        group["params"][0] = new
        setattr(self, ATTRIBUTES[group["name"]], new)

    def _splat_groups(self) -> list[dict]:
        return [g for g in self.optimizer.param_groups if g["name"] in ATTRIBUTES]

    def append(self, sources: Tensor) -> None:
        """Append copies of the points `sources`, with zero moments."""
        for group in self._splat_groups():
            old = group["params"][0]
            zeros = torch.zeros_like(old[sources])
            self._exchange(
                group, torch.cat([old, old[sources]]), lambda v, z=zeros: torch.cat([v, z])
            )

    def relocate_gs(self, dead_mask: Tensor) -> None:
        """Move the dead onto the living: moments of the *sampled* rows zeroed, in place."""
        if not bool(dead_mask.any()):
            return
        alive = (~dead_mask).nonzero()[:, 0]
        chosen = alive[torch.multinomial(self.get_opacity[alive, 0], int(dead_mask.sum()), True)]
        self._share(chosen)
        with torch.no_grad():
            for attribute in ATTRIBUTES.values():
                tensor = getattr(self, attribute)
                tensor[dead_mask] = tensor[chosen]
        self._replace(chosen)

    def add_new_gs(self, cap_max: int) -> int:
        """Grow by 5 %, up to the cap."""
        count = len(self._xyz)
        added = max(0, min(cap_max, int(1.05 * count)) - count)
        if added == 0:
            return 0
        chosen = torch.multinomial(self.get_opacity[:, 0], added, True)
        self._share(chosen)
        self.append(chosen)
        self._replace(chosen)
        return added

    def _share(self, chosen: Tensor) -> None:
        copies = torch.bincount(chosen)[chosen] + 1
        opacity, scale = relocated_values(
            self.get_opacity[chosen, 0], self.get_scaling[chosen], copies
        )
        with torch.no_grad():
            self._opacity[chosen] = torch.logit(opacity.clamp(0.005, 1 - 1e-6))[:, None]
            self._scaling[chosen] = scale.log()

    def _replace(self, chosen: Tensor) -> None:
        def zero(value: Tensor) -> Tensor:
            value[chosen] = 0
            return value

        # Before the first step there is no state, and the original fails: 3dgs-mcmc densifies
        # after 500 iterations only. Here it is survived.
        for group in self._splat_groups():
            self._exchange(group, getattr(self, ATTRIBUTES[group["name"]]), zero)


def made_model(splats: Any) -> SimulatedModel:
    """A model of raw Gaussians under gsplat's names, with its optimizer."""
    names = {"means": "_xyz", "sh0": "_features_dc", "shN": "_features_rest"}
    names |= {"scales": "_scaling", "quats": "_rotation"}
    model = SimulatedModel()
    for name, attribute in names.items():
        setattr(model, attribute, Parameter(splats[name].detach().clone()))
    model._opacity = Parameter(splats["opacities"].detach().clone()[:, None])
    model.training_setup(OPTIONS)
    return model
