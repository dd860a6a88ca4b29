"""nerfstudio: our configs in its Optimizers class (real where present) and its call sequence."""

from __future__ import annotations

import copy
import importlib
import re
import sys
import types
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from gsplat_host import HOSTS
from torch.nn import Parameter
from trainers import edit_rows, make_splats

from opt3dgs_optim import DEFAULTS, Phase

TOTAL = 40
NAMES = {"sh0": "features_dc", "shN": "features_rest"}
REAL = HOSTS / "nerfstudio/nerfstudio/engine/optimizers.py"


# -- stand-ins for nerfstudio ------------------------------------------------------------------


@dataclass
class AdamConfig:
    _target: Any = torch.optim.Adam
    lr: float = 5e-4
    eps: float = 1e-8
    max_norm: float | None = None
    weight_decay: float = 0

    def setup(self, params: Any) -> torch.optim.Optimizer:
        options = {k: v for k, v in vars(self).items() if k not in ("_target", "max_norm")}
        return self._target(params, **options)


class CallSequence:
    """What nerfstudio's Optimizers does with the configs, in its order."""

    def __init__(self, config: dict, param_groups: dict) -> None:
        self.config = config
        self.optimizers, self.schedulers, self.parameters = {}, {}, {}
        for name, params in param_groups.items():
            self.optimizers[name] = config[name]["optimizer"].setup(params=params)
            self.parameters[name] = params
            if config[name]["scheduler"]:
                make = config[name]["scheduler"].setup().get_scheduler
                rate = config[name]["optimizer"].lr
                self.schedulers[name] = make(optimizer=self.optimizers[name], lr_init=rate)

    def zero_grad_some(self, names: list[str]) -> None:
        for name in names:
            self.optimizers[name].zero_grad()

    def optimizer_scaler_step_some(self, scaler: Any, names: list[str]) -> None:
        for name in names:
            optimizer, norm = self.optimizers[name], self.config[name]["optimizer"].max_norm
            if norm is not None:
                scaler.unscale_(optimizer)
                torch.nn.utils.clip_grad_norm_(self.parameters[name], norm)
            if any(p.grad is not None for g in optimizer.param_groups for p in g["params"]):
                scaler.step(optimizer)

    def scheduler_step_all(self, step: int) -> None:
        for scheduler in self.schedulers.values():
            scheduler.step()

    def load_optimizers(self, loaded: dict) -> None:
        for name, state in loaded.items():
            self.optimizers[name].load_state_dict(state)


class Decay:
    """ExponentialDecaySchedulerConfig's two calls."""

    def setup(self) -> Decay:
        return self

    def get_scheduler(self, optimizer: Any, lr_init: float) -> Any:
        return torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: 0.01 ** (step / TOTAL))


@dataclass
class ModelConfig:
    _target: Any = None
    ssim_lambda: float = 0.2
    strategy: str = "default"


class Model(torch.nn.Module):
    """Splatfacto without a renderer."""

    def __init__(self, config: Any) -> None:
        super().__init__()
        self.config, self.step = config, 0
        self.populate_modules()

    def populate_modules(self) -> None:
        splats = make_splats()
        opacities = Parameter(splats.pop("opacities").detach()[:, None])
        splats["sh0"] = Parameter(splats["sh0"].detach()[:, 0])
        parameters = {NAMES.get(name, name): p for name, p in splats.items()}
        self.gauss_params = torch.nn.ParameterDict({**parameters, "opacities": opacities})

    def get_gaussian_param_groups(self) -> dict:
        return {name: [p] for name, p in self.gauss_params.items()}

    def get_gt_img(self, image: Any) -> Any:
        return image

    def composite_with_background(self, image: Any, background: Any) -> Any:
        return image

    def _downscale_if_required(self, image: Any) -> Any:
        return image

    def forward(self) -> dict:
        rgb = sum(p.reshape(p.shape[0], -1).mean(1) for p in self.gauss_params.values())
        return {"rgb": rgb.reshape(-1, 1), "background": None}  # type: ignore[union-attr]

    def get_training_callbacks(self, training_callback_attributes: Any) -> list:
        return []

    def load_state_dict(self, state: Any, **_: Any) -> Any:  # pyright: ignore
        for name, value in self.gauss_params.items():
            shape = (len(state["gauss_params.means"]), *value.shape[1:])
            self.gauss_params[name] = Parameter(torch.zeros(shape))
        return super().load_state_dict(state)

    def get_loss_dict(self, outputs: Any, batch: Any, metrics_dict: Any = None) -> dict:
        target, render = batch["image"], outputs["rgb"]
        if "mask" in batch:
            target, render = target * batch["mask"], render * batch["mask"]
        loss = (1 - self.config.ssim_lambda) * (target - render).abs().mean()
        return {"main_loss": 0.1 * loss, "scale_reg": torch.tensor(0.0)}


@dataclass
class Spec:
    config: Any
    description: str


def method(name: str, strategy: str) -> Any:
    slots: dict = {
        n: {"optimizer": AdamConfig(lr=5e-3, eps=1e-15), "scheduler": None} for n in GROUPS
    }
    slots["means"]["scheduler"] = Decay()
    slots["camera_opt"] = {"optimizer": AdamConfig(lr=1e-4), "scheduler": None}
    pipeline = types.SimpleNamespace(model=ModelConfig(strategy=strategy))
    return types.SimpleNamespace(
        method_name=name, max_num_iterations=TOTAL, pipeline=pipeline, optimizers=slots
    )


GROUPS = ("means", "scales", "quats", "features_dc", "features_rest", "opacities")


def modules(which: str, bases: dict) -> dict[str, Any]:
    names = ("", ".engine", ".engine.optimizers", ".models", ".models.splatfacto", ".configs")
    names += (".configs.method_configs", ".configs.base_config", ".plugins", ".plugins.types")
    names += (".utils", ".utils.writer")
    made: dict[str, Any] = {f"nerfstudio{n}": types.ModuleType(f"nerfstudio{n}") for n in names}
    made["nerfstudio.configs.base_config"].PrintableConfig = object
    made["nerfstudio.utils.writer"].put_scalar = lambda **_: None
    made["nerfstudio.utils"].writer = made["nerfstudio.utils.writer"]
    made["nerfstudio.configs"].base_config = made["nerfstudio.configs.base_config"]
    optimizers = made["nerfstudio.engine.optimizers"]
    optimizers.AdamOptimizerConfig, optimizers.Optimizers = AdamConfig, CallSequence
    made["nerfstudio.models.splatfacto"].SplatfactoModel = Model
    made["nerfstudio.models.splatfacto"].SplatfactoModelConfig = ModelConfig
    made["nerfstudio.plugins.types"].MethodSpecification = Spec
    made["nerfstudio.configs.method_configs"].method_configs = bases
    return made


@pytest.fixture(params=["call sequence", "real Optimizers"])
def ours(request: Any, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The module opt3dgs_optim.hosts.nerfstudio and the Optimizers class in use."""
    bases = {name: method(name, kind) for name, kind in BASES.items()}
    for name, module in modules(request.param, bases).items():
        monkeypatch.setitem(sys.modules, name, module)
    if request.param == "real Optimizers":
        if not REAL.is_file():
            pytest.skip(f"no {REAL}: unpack nerfstudio's wheel there, or set OPT3DGS_HOSTS")
        source = compile(REAL.read_text(), str(REAL), "exec")
        exec(source, sys.modules["nerfstudio.engine.optimizers"].__dict__)
        monkeypatch.setitem(globals(), "AdamConfig", optimizers_module().AdamOptimizerConfig)
    monkeypatch.delitem(sys.modules, "opt3dgs_optim.hosts.nerfstudio", raising=False)
    yield importlib.import_module("opt3dgs_optim.hosts.nerfstudio")
    sys.modules.pop("opt3dgs_optim.hosts.nerfstudio", None)


BASES = {"splatfacto": "default", "splatfacto-mcmc": "mcmc"}


def optimizers_module() -> Any:
    return sys.modules["nerfstudio.engine.optimizers"]


class Training:
    """nerfstudio's Trainer: set-up, and one iteration with its GradScaler."""

    def __init__(self, ours: Any, spec: Any, *, paper: bool = True, checkpoint: Any = None) -> None:
        config = spec.config.pipeline.model
        config.paper = paper
        config._target = ours.Opt3DGSSplatfactoModel
        self.model = config._target(config)
        groups = self.model.get_gaussian_param_groups()
        groups["camera_opt"] = [Parameter(torch.zeros(1, 6))]
        self.optimizers = optimizers_module().Optimizers(spec.config.optimizers.copy(), groups)
        self.scaler = torch.amp.GradScaler("cpu", enabled=False)  # pyright: ignore
        if checkpoint is not None:
            pipeline, optimizers, schedulers = checkpoint
            self.model.load_state_dict(pipeline)
            self.optimizers.load_optimizers(optimizers)
            for name, scheduler in self.optimizers.schedulers.items():
                scheduler.load_state_dict(schedulers[name])
        attributes = types.SimpleNamespace(
            optimizers=self.optimizers, trainer=types.SimpleNamespace(config=spec.config)
        )
        self.model.get_training_callbacks(attributes)

    def checkpoint(self) -> Any:
        """What nerfstudio saves."""
        optimizers = {name: o.state_dict() for name, o in self.optimizers.optimizers.items()}
        schedulers = {name: s.state_dict() for name, s in self.optimizers.schedulers.items()}
        return copy.deepcopy((self.model.state_dict(), optimizers, schedulers))

    def run(self, first: int, last: int) -> None:
        """Iterations first .. last - 1; mixed_precision is off for splatfacto."""
        names = list(self.optimizers.parameters)
        for step in range(first, last):
            self.model.step = step
            self.optimizers.zero_grad_some(names)
            outputs = self.model()
            losses = self.model.get_loss_dict(
                outputs, {"image": torch.full((len(outputs["rgb"]), 1), 0.3)}
            )
            loss = torch.stack(list(losses.values())).sum()
            self.scaler.scale(loss).backward()  # type: ignore[union-attr]
            self.optimizers.optimizer_scaler_step_some(self.scaler, names)
            self.scaler.update()
            self.optimizers.scheduler_step_all(step)


def bare(optimizers: dict) -> dict:
    return {name: o for name, o in optimizers.items() if name != "camera_opt"}


@pytest.mark.parametrize("attribute", ["splatfacto_opt3dgs", "splatfacto_mcmc_opt3dgs"])
@pytest.mark.filterwarnings("ignore::FutureWarning")
def test_a_run_with_the_switch_and_row_edits(ours: Any, attribute: str) -> None:
    training = Training(ours, getattr(ours, attribute))
    model, phases = training.model, training.model.phases
    training.run(0, 20)
    own = bare(training.optimizers.optimizers)
    assert all(o.course is phases for o in own.values())
    assert type(training.optimizers.optimizers["camera_opt"]) is torch.optim.Adam
    edit_rows(model.gauss_params, own, torch.arange(2, 12), 5)
    training.run(20, TOTAL)
    assert phases.phase is Phase.EXPLOITATION
    assert phases.iteration == TOTAL
    assert own["means"].param_groups[0]["lr"] == pytest.approx(5e-3 * 0.01)
    assert own["scales"].param_groups[0]["lr"] == 5e-3
    assert own["means"].state[model.gauss_params["means"]]["Curvature.history"].shape[0] == 15


def test_the_package_defaults_unless_the_paper_is_asked_for(ours: Any) -> None:
    assert ours.splatfacto_opt3dgs.config.pipeline.model.paper is False
    ask = Training(ours, ours.splatfacto_opt3dgs)
    plain = Training(ours, ours.splatfacto_opt3dgs, paper=False)
    assert "Curvature" in repr(ask.model.phases)
    assert "Fading" not in repr(ask.model.phases)
    assert list(plain.model.phases.parts) == list(DEFAULTS)
    relocating = Training(ours, ours.splatfacto_mcmc_opt3dgs, paper=False)
    assert list(relocating.model.phases.parts) == list(DEFAULTS)


@pytest.mark.filterwarnings("ignore::FutureWarning")
@pytest.mark.parametrize("at", [12, 39])
def test_resume(ours: Any, at: int) -> None:
    """The Parameters are new after loading: the optimizers hold them, with the loaded state."""
    whole = Training(ours, ours.splatfacto_opt3dgs)
    whole.run(0, TOTAL)
    first = Training(ours, ours.splatfacto_opt3dgs)
    first.run(0, at)
    second = Training(ours, ours.splatfacto_opt3dgs, checkpoint=first.checkpoint())
    assert second.model.phases.iteration == at
    second.run(at, TOTAL)
    for name, p in whole.model.gauss_params.items():
        assert torch.equal(p, second.model.gauss_params[name]), name
        assert second.optimizers.parameters[name][0] is second.model.gauss_params[name]


@pytest.mark.parametrize(("given", "steps"), [(None, 25), (31, 31)])
def test_the_trainers_number_of_iterations(ours: Any, given: int | None, steps: int) -> None:
    """--max-num-iterations alone: the schedule ends where the training ends."""
    spec = ours.splatfacto_opt3dgs
    spec.config.max_num_iterations = 25
    spec.config.pipeline.model.total_steps = given
    assert Training(ours, spec).model.phases.total_steps == steps


def test_without_a_number_of_iterations(ours: Any) -> None:
    training = Training(ours, ours.splatfacto_opt3dgs)
    attributes = types.SimpleNamespace(optimizers=training.optimizers, trainer=None)
    with pytest.raises(ValueError, match=r"set pipeline\.model\.total_steps"):
        training.model.get_training_callbacks(attributes)


def test_the_pixel_loss_is_squared_in_exploitation_only(ours: Any) -> None:
    model = Training(ours, ours.splatfacto_opt3dgs).model
    outputs = {"rgb": torch.full((4, 1), 0.5), "background": None}
    for mask in ({}, {"mask": torch.tensor([[1.0], [1], [0], [0]])}):
        batch = {"image": torch.zeros(4, 1), **mask}
        size = 0.25 if mask else 0.5
        model.step = 3
        first = model.get_loss_dict(outputs, batch)["main_loss"]
        assert float(first) == pytest.approx(0.1 * 0.8 * size)
        model.phases.observe(0.1, iteration=TOTAL - 1)
        model.step = TOTAL - 1
        last = model.get_loss_dict(outputs, batch)["main_loss"]
        assert float(last) == pytest.approx(0.8 * (0.1 * size + size / 2 - size))
        model.phases.observe(0.1, iteration=3)
    model.eval()
    before = model.phases.num_observed
    model.get_loss_dict(outputs, batch)
    assert model.phases.num_observed == before


def test_methods_keep_what_nerfstudio_set(ours: Any) -> None:
    spec = ours.splatfacto_mcmc_opt3dgs
    assert isinstance(spec, Spec)
    assert spec.config.method_name == "splatfacto-mcmc-opt3dgs"
    assert spec.config.pipeline.model.strategy == "mcmc"
    assert spec.config.pipeline.model.total_steps is None
    assert spec.config.optimizers["means"]["optimizer"].lr == 5e-3
    assert spec.config.optimizers["means"]["optimizer"].eps == 1e-15
    del sys.modules["nerfstudio.configs.method_configs"].method_configs["splatfacto-mcmc"]
    assert "needs a nerfstudio" in ours.splatfacto_mcmc_opt3dgs  # 1.1.5: said, and skipped
    with pytest.raises(AttributeError, match="nerfacto"):
        _ = ours.nerfacto


def test_without_nerfstudio_the_import_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "opt3dgs_optim.hosts.nerfstudio", raising=False)
    monkeypatch.setitem(sys.modules, "nerfstudio.engine.optimizers", None)
    with pytest.raises(ImportError, match="pip install nerfstudio"):
        importlib.import_module("opt3dgs_optim.hosts.nerfstudio")


def test_entry_points_name_what_there_is(ours: Any) -> None:
    text = (Path(__file__).resolve().parents[2] / "pyproject.toml").read_text(encoding="utf-8")
    found = dict(
        re.findall(r'^(splatfacto[\w-]*) = "opt3dgs_optim\.hosts\.nerfstudio:(\w+)"', text, re.M)
    )
    assert set(found) == {"splatfacto-opt3dgs", "splatfacto-mcmc-opt3dgs"}
    for name, attribute in found.items():
        assert getattr(ours, attribute).config.method_name == name
