"""Opt3DGS in nerfstudio: the methods `splatfacto-opt3dgs` and `splatfacto-mcmc-opt3dgs`.

nerfstudio finds them through the entry point `nerfstudio.method_configs`, so that after
`pip install opt3dgs_optim` beside nerfstudio

    ns-train splatfacto-opt3dgs --data DATA

just works. In a config of your own: `Opt3DGSSplatfactoModelConfig` in place of
`SplatfactoModelConfig`, and `Opt3DGSAdamOptimizerConfig` in place of `AdamOptimizerConfig` for the
six Gaussian parameters. Give the number of iterations to the model too
(`--pipeline.model.total-steps`), and leave gradient accumulation at 1.

Importing this module needs nerfstudio; nothing else in the package does.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from opt3dgs_optim.names import canonical_name
from opt3dgs_optim.phases import PhaseScheduler
from opt3dgs_optim.presets import PAPER_STEPS, PAPER_SWITCH

try:
    from nerfstudio.engine.optimizers import AdamOptimizerConfig  # pyright: ignore
    from nerfstudio.models.splatfacto import (  # pyright: ignore
        SplatfactoModel,
        SplatfactoModelConfig,
    )
except ImportError as error:
    raise ImportError(
        "opt3dgs_optim.hosts.nerfstudio needs nerfstudio and gsplat: pip install nerfstudio "
        f"(the import said: {error})"
    ) from error

TAG = "opt3dgs_slot"  # attribute of a Parameter: its scheduler and its name
_DESCRIPTION = "Gaussian Splatting with Opt3DGS's two-phase optimizer"


@dataclass
class Opt3DGSAdamOptimizerConfig(AdamOptimizerConfig):
    """nerfstudio's Adam with both phases inside; needs an `Opt3DGSSplatfactoModel`."""

    def setup(self, params: Any) -> torch.optim.Optimizer:
        """Build nerfstudio's own Adam and upgrade it."""
        slot = getattr(params[0], TAG, None) if len(params) == 1 else None
        if slot is None:
            raise ValueError(
                "Opt3DGSAdamOptimizerConfig: these parameters are not Gaussians of an "
                "Opt3DGSSplatfactoModel; set pipeline.model to Opt3DGSSplatfactoModelConfig, and "
                "use AdamOptimizerConfig for all other parameters"
            )
        phases, name = slot
        return phases.upgrade({name: super().setup(params)})[name]


@dataclass
class Opt3DGSSplatfactoModelConfig(SplatfactoModelConfig):
    """Splatfacto with the two phases of Opt3DGS."""

    _target: type = field(default_factory=lambda: Opt3DGSSplatfactoModel)
    total_steps: int = PAPER_STEPS
    """iterations of the training: give the same number as --max-num-iterations"""
    switch: float = PAPER_SWITCH
    """where exploitation starts, as a fraction of total_steps"""
    paper: bool = False
    """all parts and settings of the paper instead of the package's defaults"""


class Opt3DGSSplatfactoModel(SplatfactoModel):
    """Splatfacto that tells the optimizers its loss; its noise, if any, stays the strategy's."""

    config: Opt3DGSSplatfactoModelConfig

    def populate_modules(self) -> None:
        """As splatfacto's, with a phase scheduler."""
        super().populate_modules()
        config = self.config
        # Held in a tuple: a Module must not take it for one of its parts.
        self._phases = (
            PhaseScheduler.paper(config.total_steps, switch=config.switch)
            if config.paper
            else PhaseScheduler(config.total_steps, config.switch),
        )

    @property
    def phases(self) -> PhaseScheduler:
        """The phase scheduler of this training."""
        return self._phases[0]

    def get_gaussian_param_groups(self) -> dict[str, Any]:
        """As splatfacto's; the parameters say which optimizer they belong into."""
        groups = super().get_gaussian_param_groups()
        for name, params in groups.items():
            if canonical_name(name) is not None:
                setattr(params[0], TAG, (self.phases, name))
        return groups

    def get_loss_dict(
        self, outputs: Any, batch: Any, metrics_dict: Any = None
    ) -> dict[str, Tensor]:
        """As splatfacto's, squared while exploiting; observes the sum of all terms."""
        losses = super().get_loss_dict(outputs, batch, metrics_dict)
        if not self.training:
            return losses
        if self.phases.pixel_part() is not None:
            render, target = self._images(outputs, batch)
            change = self.phases.pixel_loss(render, target) - (render - target).abs().mean()
            losses["main_loss"] = losses["main_loss"] + (1 - self.config.ssim_lambda) * change
        energy = torch.stack([term.detach().reshape(()) for term in losses.values()]).sum()
        self.phases.observe(energy, iteration=int(self.step))
        return losses

    def _images(self, outputs: Any, batch: Any) -> tuple[Tensor, Tensor]:
        """What splatfacto compares: its rendering and the photo, masked where there is a mask."""
        photo = self.get_gt_img(batch["image"])
        target = self.composite_with_background(photo, outputs["background"])
        if "mask" not in batch:
            return outputs["rgb"], target
        mask = self._downscale_if_required(batch["mask"]).to(target.device)
        return outputs["rgb"] * mask, target * mask


def _method(base: str) -> Any:
    """nerfstudio's method `base` with our model and optimizers, under the name `base`-opt3dgs."""
    from nerfstudio.configs.method_configs import method_configs  # pyright: ignore
    from nerfstudio.plugins.types import MethodSpecification  # pyright: ignore

    if base not in method_configs:  # splatfacto-mcmc came after nerfstudio 1.1.5
        return f"{base}-opt3dgs, which needs a nerfstudio that has {base}"
    config = copy.deepcopy(method_configs[base])
    config.method_name = f"{base}-opt3dgs"
    options = {k: v for k, v in vars(config.pipeline.model).items() if k != "_target"}
    config.pipeline.model = Opt3DGSSplatfactoModelConfig(
        **options, total_steps=config.max_num_iterations
    )
    for name, slot in config.optimizers.items():
        if canonical_name(name) is not None:
            kept = {k: v for k, v in vars(slot["optimizer"]).items() if k != "_target"}
            slot["optimizer"] = Opt3DGSAdamOptimizerConfig(**kept)
    return MethodSpecification(config=config, description=f"{_DESCRIPTION} ({base})")


def __getattr__(name: str) -> Any:
    # Made when asked for: nerfstudio loads entry points in the middle of its own configs' import.
    bases = {"splatfacto_opt3dgs": "splatfacto", "splatfacto_mcmc_opt3dgs": "splatfacto-mcmc"}
    if name not in bases:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return _method(bases[name])
