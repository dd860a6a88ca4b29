"""Opt3DGS in nerfstudio: the methods `splatfacto-opt3dgs` and `splatfacto-mcmc-opt3dgs`.

nerfstudio finds them through the entry point `nerfstudio.method_configs`: install the package
beside it, then `ns-train splatfacto-opt3dgs --data DATA`. Leave gradient accumulation at 1.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from opt3dgs_optim.phases import PhaseScheduler
from opt3dgs_optim.presets import PAPER_SWITCH, paper_parts

try:
    from nerfstudio.models.splatfacto import (  # pyright: ignore
        SplatfactoModel,
        SplatfactoModelConfig,
    )
except ImportError as error:
    raise ImportError(
        "opt3dgs_optim.hosts.nerfstudio needs nerfstudio and gsplat: pip install nerfstudio "
        f"(the import said: {error})"
    ) from error

METHODS = {"splatfacto_opt3dgs": "splatfacto", "splatfacto_mcmc_opt3dgs": "splatfacto-mcmc"}


@dataclass
class Opt3DGSSplatfactoModelConfig(SplatfactoModelConfig):
    """Splatfacto with the two phases of Opt3DGS."""

    _target: type = field(default_factory=lambda: Opt3DGSSplatfactoModel)
    total_steps: int | None = None
    """iterations of the training; by default the trainer's --max-num-iterations"""
    switch: float = PAPER_SWITCH
    """where exploitation starts, as a fraction of total_steps"""
    paper: bool = False
    """all parts and settings of the paper instead of the package's defaults"""


class Opt3DGSSplatfactoModel(SplatfactoModel):
    """Splatfacto that tells the optimizers its loss; its noise, if any, stays the strategy's."""

    config: Opt3DGSSplatfactoModelConfig
    phases: PhaseScheduler | None = None  # of this training, once the trainer is set up

    def get_training_callbacks(self, training_callback_attributes: Any) -> Any:
        """As splatfacto's; upgrades the trainer's optimizers.

        The trainer calls it last in its set-up, when a checkpoint has been loaded. ValueError
        where neither the config nor a trainer says the number of iterations.
        """
        attributes, config = training_callback_attributes, self.config
        total = config.total_steps
        if total is None and attributes.trainer is not None:
            total = attributes.trainer.config.max_num_iterations
        if total is None:
            raise ValueError(
                "Opt3DGSSplatfactoModel: total_steps=None and no trainer, but the number of "
                "iterations is needed; set pipeline.model.total_steps"
            )
        parts = paper_parts(total) if config.paper else None
        self.phases = PhaseScheduler(total, config.switch, parts)
        for name, (param,) in self.get_gaussian_param_groups().items():
            # On a resume nerfstudio builds its optimizers first and makes new Parameters then, that
            # none of them would ever step; the loaded state is the new one's.
            optimizer = attributes.optimizers.optimizers[name]
            (group,) = optimizer.param_groups
            (old,), group["params"] = group["params"], [param]
            if old in optimizer.state:
                optimizer.state[param] = optimizer.state.pop(old)
            attributes.optimizers.parameters[name] = [param]
        self.phases.upgrade(attributes.optimizers.optimizers)
        return super().get_training_callbacks(attributes)

    def get_loss_dict(
        self, outputs: Any, batch: Any, metrics_dict: Any = None
    ) -> dict[str, Tensor]:
        """As splatfacto's, squared while exploiting; observes the sum of all terms."""
        losses = super().get_loss_dict(outputs, batch, metrics_dict)
        phases = self.phases if self.training else None
        if phases is None:
            return losses
        if phases.pixel_part() is not None:
            render, photo = outputs["rgb"], self.get_gt_img(batch["image"])
            target = self.composite_with_background(photo, outputs["background"])
            if "mask" in batch:
                mask = self._downscale_if_required(batch["mask"]).to(target.device)
                render, target = render * mask, target * mask
            change = phases.pixel_loss(render, target) - (render - target).abs().mean()
            losses["main_loss"] = losses["main_loss"] + (1 - self.config.ssim_lambda) * change
        energy = torch.stack([term.detach().reshape(()) for term in losses.values()]).sum()
        phases.observe(energy, iteration=int(self.step))
        return losses


def __getattr__(name: str) -> Any:
    # Made when asked for: nerfstudio loads entry points in the middle of its own configs' import.
    if name not in METHODS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from nerfstudio.configs.method_configs import method_configs  # pyright: ignore
    from nerfstudio.plugins.types import MethodSpecification  # pyright: ignore

    base = METHODS[name]
    if base not in method_configs:  # splatfacto-mcmc came after nerfstudio 1.1.5
        return f"{base}-opt3dgs, which needs a nerfstudio that has {base}"
    config = copy.deepcopy(method_configs[base])
    config.method_name = f"{base}-opt3dgs"
    options = {k: v for k, v in vars(config.pipeline.model).items() if k != "_target"}
    config.pipeline.model = Opt3DGSSplatfactoModelConfig(**options)
    description = f"Gaussian Splatting with Opt3DGS's two-phase optimizer ({base})"
    return MethodSpecification(config=config, description=description)
