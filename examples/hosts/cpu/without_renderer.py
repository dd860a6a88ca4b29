"""Optimizers, density control and checkpoints of trainers whose renderers need CUDA, on a CPU.

    python examples/hosts/cpu/without_renderer.py 3dgrut TRAINERS/3dgrut
    python examples/hosts/cpu/without_renderer.py fvdb TRAINERS/fvdb-0.6.0

fVDB's folder is made by `pip install --no-deps --target TRAINERS/fvdb-0.6.0
fvdb-reality-capture==0.6.0`. 3DGRUT needs hydra-core.

3DGRUT and fVDB reality capture render with kernels of their own. What touches an optimizer is
Python, and runs here from their sources: how they make it, move, add and remove Gaussians in it,
save it and load it. In place of a render stands a loss with known minima. Printed is what holds, as
JSON: that with no parts the steps are the trainer's own, bit for bit; that with the parts of its
lines it trains on through every edit and ends at the mean; that a training resumed from the
trainer's own checkpoint ends bit for bit as the uninterrupted one does; and that `finish()` puts
the mean where it is called.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import cpu_cuda
import cpu_stand_ins
import torch
from cpu_gsplat import masked_adam, relocation
from splatting.relocation import relocated_values
from torch import Tensor
from torch.nn import Parameter

from opt3dgs_optim import PhaseScheduler

ITERATIONS = 60
POINTS = 40
BEFORE = "what holds:\n"  # the figures, below what the trainers print


class Host(Protocol):
    """A trainer without its renderer."""

    relocates: bool

    def parameters(self) -> dict[str, Tensor]:
        """The Gaussians, by the names of their groups."""
        ...

    def optimizer(self) -> Any:
        """What the last of the trainer's lines upgrades."""
        ...

    def step(self) -> None:
        """The trainer's own step."""
        ...

    def control(self, iteration: int) -> None:
        """The trainer's own density control."""
        ...

    def checkpoint(self) -> dict[str, Any]:
        """What the trainer saves."""
        ...


def start_values(widths: dict[str, int]) -> dict[str, Tensor]:
    """Gaussians to begin with, the same in every run."""
    torch.manual_seed(1)
    return {name: torch.randn(POINTS, width) * 0.5 - 1.0 for name, width in widths.items()}


def bare_package(name: str, sources: Path) -> None:
    """Have a package's modules without what its `__init__` imports: readers, viewers."""
    package = types.ModuleType(name)
    package.__path__ = [str(sources / name.replace(".", "/"))]
    sys.modules[name] = package


# -- 3DGRUT ----------------------------------------------------------------------------------------


class Threedgrut:
    """`MixtureOfGaussians` with the strategy of a configuration."""

    def __init__(self, config: Any, saved: dict[str, Any] | None = None) -> None:
        module = importlib.import_module("threedgrut.model.model")
        self.model = module.MixtureOfGaussians(config, scene_extent=1.0)
        if saved is not None:
            self.model.init_from_checkpoint(saved)
        else:
            widths = {
                **{"positions": 3, "rotation": 4, "scale": 3, "density": 1, "features_albedo": 3},
                "features_specular": self.model.features_specular.shape[1],
            }
            for name, value in start_values(widths).items():
                setattr(self.model, name, Parameter(value))
            self.model.setup_optimizer()
        kind = "MCMCStrategy" if config.strategy.method == "MCMCStrategy" else "GSStrategy"
        source = "mcmc" if kind == "MCMCStrategy" else "gs"
        strategies: Any = importlib.import_module(f"threedgrut.strategy.{source}")
        if source == "mcmc":  # its CUDA extension
            strategies.load_mcmc_plugin = lambda: None
            strategies._mcmc_plugin = types.SimpleNamespace(compute_relocation_tensor=relocation)
        self.strategy = getattr(strategies, kind)(config, self.model)
        self.strategy.init_densification_buffer()
        self.relocates = source == "mcmc"
        self.selective = config.optimizer.type == "selective_adam"

    def parameters(self) -> dict[str, Tensor]:
        return {g["name"]: g["params"][0] for g in self.model.optimizer.param_groups}

    def optimizer(self) -> Any:
        return self.model.optimizer

    def step(self) -> None:
        optimizer = self.model.optimizer
        if self.selective:
            optimizer.step(torch.rand(self.model.density.shape) < 0.8)
        else:
            optimizer.step()
        optimizer.zero_grad()
        self.model.scheduler_step(0)

    def control(self, iteration: int) -> None:
        if self.relocates:
            if iteration % 10 == 5:
                with torch.no_grad():
                    self.model.density[:4] = -8.0  # dead, so that they are relocated
                self.strategy.relocate_gaussians()
                self.strategy.add_new_gaussians()
            self.strategy.perturb_gaussians()
        elif iteration % 20 == 5:
            rows = self.model.num_gaussians
            large = torch.arange(rows).reshape(-1, 1) % 7 == 0
            self.strategy.densify_grad_norm_accum = large.float()
            self.strategy.densify_grad_norm_denom = torch.ones_like(large.float())
            self.strategy.densify_gaussians(scene_extent=1.0)
            with torch.no_grad():
                self.model.density[:2] = -8.0
            self.strategy.prune_gaussians_opacity()
        elif iteration == 30:
            self.strategy.reset_density()

    def checkpoint(self) -> dict[str, Any]:
        return self.model.get_model_parameters()


def threedgrut(sources: Path, app: str, *changes: str) -> Callable[..., Host]:
    """A maker of 3DGRUT's model under one of its configurations, with changes to it."""
    from hydra import compose, initialize_config_dir  # pyright: ignore

    for name in ("threedgrt_tracer", "threedgut_tracer"):
        sys.modules[name] = cpu_stand_ins.Empty(name)
    sys.path.insert(0, str(sources))
    bare_package("threedgrut.datasets", sources)
    torch.cuda.nvtx.range_push = torch.cuda.nvtx.range_pop = lambda *_: 0
    optimizers: Any = importlib.import_module("threedgrut.optimizers")
    optimizers._optimizer_plugin = types.SimpleNamespace(selective_adam_update=masked_adam)
    with initialize_config_dir(str((sources / "configs").resolve()), version_base=None):
        config = compose(app, overrides=list(changes))
    return lambda saved=None: Threedgrut(config, saved)


# -- fVDB ------------------------------------------------------------------------------------------

FVDB = {"means": 3, "log_scales": 3, "quats": 4, "logit_opacities": 1, "sh0": 3, "shN": 9}


class SplatModel:
    """What of `fvdb.GaussianSplat3d` its optimizer uses."""

    accumulate_mean_2d_gradients = accumulate_max_2d_radii = False

    def __init__(self, values: dict[str, Tensor]) -> None:
        self.set_state(**values)

    def set_state(
        self,
        means: Tensor,
        quats: Tensor,
        log_scales: Tensor,
        logit_opacities: Tensor,
        sh0: Tensor,
        shN: Tensor,
    ) -> None:
        """Take new Gaussians, as the real one does."""
        given = (means, log_scales, quats, logit_opacities, sh0, shN)
        values = dict(zip(FVDB, given, strict=True))
        for name, value in values.items():
            leaf = value if value.is_leaf and value.requires_grad else value.detach()
            setattr(self, name, leaf.requires_grad_(True))
        rows = len(values["means"])
        self.accumulated_gradient_step_counts = torch.ones(rows, dtype=torch.int32)
        self.accumulated_mean_2d_gradient_norms = (torch.arange(rows) % 7 == 0).float()

    @property
    def num_gaussians(self) -> int:
        return len(self.means)  # pyright: ignore

    @property
    def device(self) -> torch.device:
        return torch.device("cpu")

    @property
    def scales(self) -> Tensor:
        return self.log_scales.exp()  # pyright: ignore

    @property
    def opacities(self) -> Tensor:
        return self.logit_opacities.sigmoid()  # pyright: ignore

    def reset_accumulated_gradient_state(self) -> None:
        """Nothing was accumulated."""

    @torch.no_grad()
    def add_noise_to_means(self, noise_scale: float) -> None:
        """Noise of the size that the optimizer says."""
        means: Tensor = self.means  # pyright: ignore
        means.add_(torch.randn_like(means), alpha=1e-6 * noise_scale)

    def relocate_gaussians(
        self, log_scales: Tensor, logit_opacities: Tensor, ratios: Tensor, **others: Any
    ) -> tuple[Tensor, Tensor]:
        """Opacities and scales of relocated Gaussians, in the place of the kernel's."""
        opacities, scales = logit_opacities.sigmoid(), log_scales.exp()
        new_opacities, new_scales = relocated_values(opacities, scales, ratios.long())
        return torch.logit(new_opacities.clamp(others["min_opacity"], 1 - 1e-6)), new_scales.log()


class Fvdb:
    """`GaussianSplatOptimizer` of version 0.6, over a model without a renderer."""

    kind = ""  # "_mcmc" for MCMC
    relocates = False

    def __init__(self, saved: dict[str, Any] | None = None) -> None:
        name = f"fvdb_reality_capture.radiance_fields.gaussian_splat_optimizer{self.kind}"
        module = importlib.import_module(name)
        kind = f"GaussianSplatOptimizer{self.kind[1:].upper()}"
        optimizer, config = getattr(module, kind), getattr(module, f"{kind}Config")
        if saved is not None:
            self.model = SplatModel({k: v.clone() for k, v in saved["model"].items()})
            self.trainer = optimizer.from_state_dict(self.model, saved["optimizer"])
            return
        values = start_values(FVDB)
        values["logit_opacities"] = values["logit_opacities"].reshape(-1)
        for name in ("sh0", "shN"):
            values[name] = values[name].reshape(POINTS, -1, 3)
        self.model = SplatModel(values)
        scene = types.SimpleNamespace(spatial_scale=lambda mode: 1.0)
        self.trainer = optimizer.from_model_and_scene(self.model, scene, config())
        self.trainer.reset_learning_rates_and_decay(1, ITERATIONS)

    def parameters(self) -> dict[str, Tensor]:
        return {name: getattr(self.model, name) for name in FVDB}

    def optimizer(self) -> Any:
        return self.trainer._optimizer

    def step(self) -> None:
        self.trainer.step()
        self.trainer.zero_grad(set_to_none=True)

    def control(self, iteration: int) -> None:
        if iteration % 20 == 5:
            with torch.no_grad():
                self.model.logit_opacities[:4] = -8.0  # pyright: ignore  # dead
            self.trainer.refine()

    def checkpoint(self) -> dict[str, Any]:
        model = {name: getattr(self.model, name).detach() for name in FVDB}
        return {"model": model, "optimizer": self.trainer.state_dict()}


class FvdbMcmc(Fvdb):
    """With `GaussianSplatOptimizerMCMC`."""

    kind = "_mcmc"
    relocates = True


def fvdb(sources: Path) -> dict[str, Callable[..., Host]]:
    """Makers of fVDB's optimizers."""
    sys.path.insert(0, str(sources))
    sys.modules["fvdb"] = cpu_stand_ins.Empty("fvdb")
    for name in ("fvdb_reality_capture", "fvdb_reality_capture.radiance_fields"):
        bare_package(name, sources)
    sys.modules["fvdb"].morton = _morton  # pyright: ignore
    scene: Any = cpu_stand_ins.Empty("fvdb_reality_capture.sfm_scene")
    scene.SpatialScaleMode = types.SimpleNamespace(MEDIAN_CAMERA_DEPTH=0)
    for name in (scene.__name__, f"{scene.__name__}.sfm_scene"):
        sys.modules[name] = scene
    model = "fvdb_reality_capture.radiance_fields.gaussian_splatting"
    sys.modules[model] = cpu_stand_ins.Empty(model)
    return {"GaussianSplatOptimizer": Fvdb, "GaussianSplatOptimizerMCMC": FvdbMcmc}


def _morton(cells: Tensor) -> Tensor:
    """The Morton code of cells [N, 3] of 21 bits each."""
    code = torch.zeros(len(cells), dtype=torch.int64)
    for bit in range(21):
        for axis in range(3):
            code |= ((cells[:, axis].long() >> bit) & 1) << (3 * bit + axis)
    return code


# -- what is tried ---------------------------------------------------------------------------------


def train(host: Host, first: int, last: int) -> None:
    """Iterations of the trainer's order: backward, step, density control."""
    for iteration in range(first, last):
        torch.manual_seed(iteration)
        terms = []
        for value in host.parameters().values():
            visible = torch.rand(len(value)) < 0.7
            goal = torch.randn(1) * 0.1 - 1.0
            terms.append(((value - goal)[visible]).square().sum() / POINTS)
        torch.stack(terms).sum().backward()
        host.step()
        host.control(iteration)


def begun(make: Callable[..., Host], *saved: Any, parts: Any = None) -> tuple[Host, PhaseScheduler]:
    """The trainer with its lines."""
    host = make(*saved)
    phases = PhaseScheduler(ITERATIONS, parts=parts)
    phases.upgrade(host.optimizer())
    return host, phases


def at_the_mean(host: Host, phases: PhaseScheduler) -> bool:
    """Whether the parameters are the running means; noise may have come after them."""
    pairs = [
        (phases.param_of(*key), (phases.state_of_param(*key) or {})["averaging.mean"])
        for key in phases.members
        if not (host.relocates and key[1] == "means")
    ]
    return all(torch.equal(a, b) for a, b in pairs if a is not None)


def try_out(make: Callable[..., Host]) -> dict[str, Any]:
    """What holds of a trainer."""
    stock, (plain, _), (whole, phases) = make(), begun(make, parts=[]), begun(make)
    half, early = begun(make)[0], begun(make)
    for each in (stock, plain, whole):
        train(each, 0, ITERATIONS)
    train(half, 0, ITERATIONS // 2)
    resumed, again = begun(make, half.checkpoint())
    at = again.iteration + 1
    train(resumed, at, ITERATIONS)
    train(early[0], 0, ITERATIONS - 1)
    early[1].finish()
    finite = all(bool(value.isfinite().all()) for value in whole.parameters().values())
    return {
        "names": list(stock.parameters()),
        "points": [POINTS, len(next(iter(whole.parameters().values())))],
        "without parts the trainer's own": _same(stock, plain),
        "with the parts finite and another": finite and not _same(stock, whole),
        "ends at the mean": at_the_mean(whole, phases),
        "finish() ends at the mean": at_the_mean(*early),
        "resumed at": at,
        "resumed as uninterrupted": _same(whole, resumed),
    }


def _same(one: Host, other: Host) -> bool:
    pairs = zip(one.parameters().values(), other.parameters().values(), strict=True)
    return all(torch.equal(a, b) for a, b in pairs)


def main() -> None:
    """Try a trainer, and print what holds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("trainer", choices=("3dgrut", "fvdb"))
    parser.add_argument("sources", type=Path, help="the folder of its repository")
    options = parser.parse_args()
    cpu_stand_ins.install()
    cpu_cuda.install()
    if options.trainer == "fvdb":
        found = {name: try_out(make) for name, make in fvdb(options.sources).items()}
    else:
        apps = ("apps/colmap_3dgut_mcmc", "apps/colmap_3dgut")
        found = {
            " ".join(form): try_out(threedgrut(options.sources, *form))
            for app in apps
            for form in ((app,), (app, "optimizer.type=selective_adam"))
        }
    print(f"{BEFORE}{json.dumps(found, indent=1)}")


if __name__ == "__main__":
    main()
