"""The methods `splatfacto-opt3dgs` and `splatfacto-mcmc-opt3dgs` of nerfstudio.

nerfstudio finds them through the entry point `nerfstudio.method_configs`: install the package
beside it, then `ns-train splatfacto-opt3dgs --data DATA`.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from typing import Any

from opt3dgs_optim import PhaseScheduler

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
    """Splatfacto, whose optimizers are upgraded."""

    _target: type = field(default_factory=lambda: Opt3DGSSplatfactoModel)


class Opt3DGSSplatfactoModel(SplatfactoModel):
    """Splatfacto, which upgrades the trainer's optimizers when it is set up."""

    config: Opt3DGSSplatfactoModelConfig
    phases: PhaseScheduler | None = None  # of this training, once the trainer is set up

    def get_training_callbacks(self, training_callback_attributes: Any) -> Any:
        """As splatfacto's; the trainer calls it when a checkpoint has been loaded.

        Raises:
            ValueError: the training is a resumed one, or Gaussians' gradients are accumulated.
        """
        attributes = training_callback_attributes
        trainer, optimizers = attributes.trainer, attributes.optimizers.optimizers
        held = {id(p) for o in optimizers.values() for g in o.param_groups for p in g["params"]}
        if not held.issuperset(map(id, self.gauss_params.values())):
            raise ValueError(
                "Opt3DGSSplatfactoModel: nerfstudio's optimizers do not hold the Gaussians of the "
                "checkpoint that it has loaded, and would not train them; train in one piece"
            )
        asked = trainer.config.gradient_accumulation_steps
        if any(asked.get(name, 1) > 1 for name in self.gauss_params):
            raise ValueError(
                f"Opt3DGSSplatfactoModel: gradient_accumulation_steps={asked} leave out steps of "
                "Gaussians; 1 is needed for them"
            )
        self.phases = PhaseScheduler(trainer.config.max_num_iterations)
        self.phases.upgrade(optimizers)
        return super().get_training_callbacks(attributes)


def __getattr__(name: str) -> Any:
    # Made when asked for: nerfstudio loads entry points in the middle of its own configs' import.
    if name not in METHODS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from nerfstudio.configs.method_configs import method_configs  # pyright: ignore
    from nerfstudio.plugins.types import MethodSpecification  # pyright: ignore

    # nerfstudio 1.1.5 has no splatfacto-mcmc. The same method twice is one method there, where
    # anything but a method would make it print a warning at every start.
    base = METHODS[name] if METHODS[name] in method_configs else "splatfacto"
    config = copy.deepcopy(method_configs[base])
    config.method_name = f"{base}-opt3dgs"
    options = {k: v for k, v in vars(config.pipeline.model).items() if k != "_target"}
    config.pipeline.model = Opt3DGSSplatfactoModelConfig(**options)
    return MethodSpecification(config=config, description=f"{base} with opt3dgs_optim's steps")
