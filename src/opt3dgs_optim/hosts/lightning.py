"""The plugin `Opt3DGS` of gaussian-splatting-lightning (yzslab), named in a configuration:

model:
  plugins+:
    - class_path: opt3dgs_optim.hosts.lightning.Opt3DGS
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from opt3dgs_optim import PhaseScheduler

try:
    from internal.plugins.plugin import Plugin, PluginModule  # pyright: ignore
except ImportError as error:
    raise ImportError(
        "opt3dgs_optim.hosts.lightning belongs into gaussian-splatting-lightning, whose folder "
        f"must be on the path: run its main.py (the import said: {error})"
    ) from error


@dataclass
class Opt3DGS(Plugin):
    """Upgrades the Gaussians' optimizers."""

    total_steps: int | None = None
    """iterations of the training; by default the trainer's --max_steps"""

    def instantiate(self) -> Opt3DGSModule:
        """The module that acts; the trainer calls this when it has made its optimizers."""
        return Opt3DGSModule(self)


class Opt3DGSModule(PluginModule):
    """Upgrades the optimizers, and keeps the trainer's count of iterations."""

    config: Opt3DGS
    phases: PhaseScheduler

    def setup(self, pl_module: Any) -> None:
        """Upgrade `pl_module.gaussian_optimizers`.

        The trainer calls it in `configure_optimizers`. Lightning loads the optimizers' states of a
        checkpoint after that.

        Raises:
            ValueError: the number of iterations is not known, as where the trainer counts epochs
                and the plugin has no `total_steps`, or gradients are accumulated.
            TypeError: the optimizers are none of torch's Adam.
        """
        trainer, total = pl_module.trainer, self.config.total_steps
        if total is None and (trainer.max_steps < 1 or (trainer.max_epochs or 0) > 0):
            raise ValueError(
                f"Opt3DGS: max_steps={trainer.max_steps} and max_epochs={trainer.max_epochs} of "
                "the trainer, but the number of iterations is needed; set total_steps of the plugin"
            )
        strategy = type(pl_module.hparams["opt_strategy"]).__name__
        if strategy.startswith("GradAcc"):  # it takes all but torch's own classes for sparse Adams
            raise ValueError(
                f"Opt3DGS: opt_strategy={strategy} would not accumulate gradients for upgraded "
                "optimizers; VanillaOptStrategy is needed"
            )
        self.phases = PhaseScheduler(trainer.max_steps if total is None else total)
        self.phases.upgrade(pl_module.gaussian_optimizers)
        pl_module.on_after_backward_hooks.append(self._count)

    def _count(
        self, outputs: Any, batch: Any, gaussian_model: Any, step: int, pl_module: Any
    ) -> None:
        """The trainer's iteration, which it counts from 1: a checkpoint of stock has no clock."""
        self.phases.observe(iteration=step - 1)
