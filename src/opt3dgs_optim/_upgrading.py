"""How a trainer's optimizers get the two phases: the part of `PhaseScheduler` that does it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, overload

from torch import Tensor
from torch.optim import Optimizer

from opt3dgs_optim._groups import GAUSSIAN_NAMES, canonical_name
from opt3dgs_optim._mistakes import check_one_noise, warn_of_scheduler
from opt3dgs_optim._phased import PhasedAdam, check_upgradable, named_groups
from opt3dgs_optim._scene import follow
from opt3dgs_optim.lqnadam import CurvatureOptions
from opt3dgs_optim.noise import CovarianceNoise, GaussianTensors

CALL = "PhaseScheduler"


class Upgrading:
    """Base of `PhaseScheduler`."""

    noise_scale: float
    curvature_options: CurvatureOptions

    def __init__(self) -> None:
        self._noise: CovarianceNoise | None = None
        self._positions: PhasedAdam | None = None
        self._upgraded: list[PhasedAdam] = []

    @overload
    def upgrade(
        self, optimizers: dict[str, Any], gaussians: Any = None, strategy: Any = None
    ) -> dict[str, Optimizer]: ...
    @overload
    def upgrade(
        self, optimizers: Optimizer, gaussians: Any = None, strategy: Any = None
    ) -> Optimizer: ...
    def upgrade(
        self,
        optimizers: dict[str, Any] | Optimizer,
        gaussians: GaussianTensors | Callable[[], GaussianTensors] | None = None,
        strategy: Any = None,
    ) -> dict[str, Optimizer] | Optimizer:
        """Return the trainer's optimizer(s) with both phases inside.

        Learning rates, betas, eps, names and state are kept; learning rates are never changed.

        Args:
            optimizers: a dict of `torch.optim.Adam`, one per parameter (gsplat, nerfstudio), or
                one Adam with named groups (INRIA, 3dgs-mcmc). Those that hold no Gaussian
                parameter (camera poses, exposures) come back as they are, or stay plain Adam.
            gaussians: the trainer's dict of raw tensors, or a function returning it: `scales`
                [N, 3] log, `quats` [N, 4] wxyz, `opacities` [N] or [N, 1] logits. Needed with
                `noise_scale > 0`.
            strategy: what says the trainer's own noise_lr (gsplat's MCMCStrategy, 3dgs-mcmc's
                arguments): noise twice is refused.

        The old optimizers must not be used any more: their `step()` raises from now on.

        Raises:
            TypeError: an optimizer of Gaussian parameters is not torch's Adam.
            ValueError: no group holds positions, a name occurs twice, `gaussians` is missing, or
                the noise would be injected twice.
        """
        check_one_noise(self.noise_scale, strategy)
        self._noise = self._make_noise(gaussians)
        if isinstance(optimizers, Optimizer):
            names = named_groups(optimizers)
            _require_positions(names)
            return self._take(check_upgradable(optimizers, "the optimizer"), "the optimizer")
        if not isinstance(optimizers, Mapping):
            raise TypeError(
                f"{CALL}.upgrade: optimizers is a {type(optimizers).__name__}, but a dict of "
                "optimizers, or one optimizer with named groups, is needed"
            )
        _require_positions(list(optimizers))
        upgraded: dict[str, Optimizer] = {}
        for name, optimizer in optimizers.items():
            known = canonical_name(name) is not None
            upgraded[name] = self.upgrade_slot(name, optimizer) if known else optimizer
        return upgraded

    def upgrade_slot(self, name: str, optimizer: Optimizer) -> PhasedAdam:
        """Upgrade the optimizer of one Gaussian parameter, for trainers that make them singly.

        Args:
            name: gsplat's, INRIA's or nerfstudio's name of the parameter.
            optimizer: its `torch.optim.Adam`.

        Raises:
            TypeError, ValueError: as `upgrade`.
        """
        if canonical_name(name) is None:
            raise ValueError(f"{CALL}.upgrade_slot: name={name!r} is no Gaussian parameter's")
        shown = f"optimizers[{name!r}]"
        adam = check_upgradable(optimizer, shown)
        named_groups(adam)
        for group in adam.param_groups:
            group.setdefault("name", name)
        return self._take(adam, shown)

    def reset_points(self, rows: Tensor, *, moments: bool = False) -> None:
        """Say which points have moved by other means than the optimizers: see LQNAdam's.

        Args:
            rows: [N] bool mask or a vector of indices, of the points as they are now.
            moments: whether to start their Adam moments anew too, in all Gaussian parameters.
        """
        for optimizer in self._upgraded:
            if moments or optimizer is self._positions:
                optimizer.reset_points(rows, moments=moments)

    def drop_pairs(self) -> None:
        """Free all curvature pairs; new ones are taken by the present `curvature_options`."""
        for optimizer in self._upgraded:
            optimizer.curvature_options = self.curvature_options
            optimizer.drop_pairs()

    def follow_scene(self, scene: Any) -> None:
        """Let a scene of gsplat 1.6 tell which rows its density control moved.

        Without it every edit drops all curvature pairs; with it only those of moved points.
        """
        follow(scene, self.reset_points)

    def _take(self, optimizer: Any, shown: str) -> PhasedAdam:
        warn_of_scheduler(optimizer, shown)
        phased = PhasedAdam(optimizer, self)  # pyright: ignore[reportArgumentType]
        self._upgraded.append(phased)
        if any(canonical_name(group.get("name")) == "means" for group in phased.param_groups):
            self._positions = phased
        return phased

    def _make_noise(self, gaussians: Any) -> CovarianceNoise | None:
        if self.noise_scale == 0:
            return None
        if gaussians is None:
            raise ValueError(
                f"{CALL}.upgrade: gaussians=None, but noise_scale={self.noise_scale} needs the "
                "trainer's dict of scales, quats and opacities (or a function returning it)"
            )
        return CovarianceNoise(gaussians, self.noise_scale, backend=self.curvature_options.backend)


def _require_positions(names: list[str]) -> None:
    if not any(canonical_name(name) == "means" for name in names):
        raise ValueError(
            f"{CALL}.upgrade: none of the names {names} stands for positions; "
            f"{' or '.join(GAUSSIAN_NAMES['means'])} is needed"
        )
