"""The methods `splatfacto-opt3dgs` and `splatfacto-mcmc-opt3dgs` of nerfstudio.

nerfstudio finds them through the entry point `nerfstudio.method_configs`: install the package
beside it, then `ns-train splatfacto-opt3dgs --data DATA`. Leave gradient accumulation at 1.
"""

from __future__ import annotations

import copy
import inspect
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
    total_steps: int | None = None
    """steps of the training; by default until the trainer's last iteration"""


class Opt3DGSSplatfactoModel(SplatfactoModel):
    """Splatfacto, which upgrades the trainer's optimizers when it is set up."""

    config: Opt3DGSSplatfactoModelConfig
    phases: PhaseScheduler | None = None  # of this training, once the trainer is set up

    def get_training_callbacks(self, training_callback_attributes: Any) -> Any:
        """As splatfacto's; the trainer calls it when a checkpoint has been loaded.

        Raises:
            ValueError: neither the config nor a trainer says the number of iterations.
        """
        attributes, total = training_callback_attributes, self.config.total_steps
        if total is None and attributes.trainer is not None:
            total = end_of(attributes.trainer)
        if total is None:
            raise ValueError(
                "Opt3DGSSplatfactoModel: total_steps=None and no trainer, but the number of "
                "iterations is needed; set pipeline.model.total_steps"
            )
        self.phases = PhaseScheduler(total)
        self.phases.upgrade(attributes.optimizers.optimizers)
        return super().get_training_callbacks(attributes)


def end_of(trainer: Any) -> int:
    """The iteration at which a trainer ends; after a resume, 1.1.5 makes all of them once more."""
    # Both call themselves 1.1.5: only the code of `train` tells them apart.
    left_only = "max_num_iterations - self._start_step" in inspect.getsource(type(trainer).train)
    return trainer.config.max_num_iterations + (0 if left_only else trainer._start_step)


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
    return MethodSpecification(config=config, description=f"{base} with Opt3DGS's optimizers")
