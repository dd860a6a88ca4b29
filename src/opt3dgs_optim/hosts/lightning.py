"""Opt3DGS in gaussian-splatting-lightning (yzslab): the plugin `Opt3DGS`.

Nothing of the trainer is edited. With the package installed beside it, the plugin is named in the
trainer's configuration. (CityGaussian, which derives from it, has no plugins.)

    model:
      plugins:
        - class_path: opt3dgs_optim.hosts.lightning.Opt3DGS
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from opt3dgs_optim.phases import PhaseScheduler
from opt3dgs_optim.presets import PAPER_SWITCH, paper_parts

try:
    from internal.plugins.plugin import Plugin, PluginModule  # pyright: ignore
except ImportError as error:
    raise ImportError(
        "opt3dgs_optim.hosts.lightning belongs into gaussian-splatting-lightning, whose folder "
        f"must be on the path: run its main.py (the import said: {error})"
    ) from error


@dataclass
class Opt3DGS(Plugin):
    """Two phases in the steps of the Gaussians' optimizers, as the trainer's plugin."""

    total_steps: int | None = None
    """iterations of the training; by default the trainer's --max_steps"""
    switch: float = PAPER_SWITCH
    """where exploitation starts, as a fraction of total_steps"""
    paper: bool = False
    """all parts and settings of the paper instead of the package's defaults"""

    def instantiate(self) -> Opt3DGSModule:
        """The module that acts; the trainer calls this when it has made its optimizers."""
        return Opt3DGSModule(self)


class Opt3DGSModule(PluginModule):
    """Upgrades the optimizers, and observes the loss of each iteration after its backward."""

    config: Opt3DGS
    phases: PhaseScheduler

    def setup(self, pl_module: Any) -> None:
        """Upgrade `pl_module.gaussian_optimizers`, and register the hooks.

        The trainer calls it in `configure_optimizers`, before a checkpoint's optimizer states are
        loaded, so that a resumed training goes on in its phase.

        Raises:
            ValueError: neither the plugin nor the trainer says the number of iterations, or the
                trainer's strategy of accumulating gradients would not know the optimizers.
            TypeError: the optimizers are none of torch's Adam.
        """
        config = self.config
        total = pl_module.trainer.max_steps if config.total_steps is None else config.total_steps
        if total is None or total < 1:
            raise ValueError(
                f"Opt3DGS: total_steps={config.total_steps} and max_steps={total} of the trainer, "
                "but the number of iterations is needed; set total_steps of the plugin"
            )
        parts = paper_parts(total) if config.paper else None
        self.phases = PhaseScheduler(total, config.switch, parts)
        self.phases.upgrade(pl_module.gaussian_optimizers)
        for optimizer in pl_module.gaussian_optimizers:
            self._check_strategy(pl_module, optimizer)
        self._metrics: dict[str, Tensor] = {}
        pl_module.extra_train_metrics.append(self._take_metrics)
        pl_module.on_after_backward_hooks.append(self._observe)
        self._use_pixel_loss(pl_module)

    def _check_strategy(self, pl_module: Any, optimizer: Any) -> None:
        """ValueError where `GradAccOptStrategy` would take an optimizer for a sparse one.

        It asks whether the module of the optimizer's class is one of torch's, and steps all others
        in every iteration.
        """
        strategy = type(pl_module.hparams["opt_strategy"]).__name__
        if strategy.startswith("GradAcc") and not optimizer.__module__.startswith("torch.optim."):
            raise ValueError(
                f"Opt3DGS: opt_strategy={strategy} would not accumulate gradients for "
                f"{optimizer.__module__}.{type(optimizer).__name__}; VanillaOptStrategy is needed"
            )

    def _use_pixel_loss(self, pl_module: Any) -> None:
        """Have the photometric term of a part that has one of its own, in the training only."""
        metric = pl_module.metric
        stock = getattr(metric, "rgb_diff_loss_fn", None)
        if stock is None:
            return

        def photometric(render: Tensor, photo: Tensor) -> Tensor:
            own = pl_module.training and self.phases.pixel_part() is not None
            return self.phases.pixel_loss(render, photo) if own else stock(render, photo)

        metric.rgb_diff_loss_fn = photometric

    def _take_metrics(
        self, outputs: Any, batch: Any, gaussian_model: Any, step: int, pl_module: Any, *given: Any
    ) -> None:
        """Keep the metrics of this iteration, whose loss later hooks may still change."""
        self._metrics = given[0]

    def _observe(
        self, outputs: Any, batch: Any, gaussian_model: Any, step: int, pl_module: Any
    ) -> None:
        """Observe the total loss; the trainer counts from 1."""
        self.phases.observe(self._metrics["loss"], iteration=step - 1)
        self._metrics = {}
