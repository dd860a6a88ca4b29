"""nerfstudio's methods, with stand-ins for its classes in its order of calls."""

from __future__ import annotations

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
from torch.nn import Parameter

from opt3dgs_optim import DEFAULTS

ROOT = Path(__file__).resolve().parents[2]
TOTAL = 40
WIDTHS = {"means": 3, "scales": 3, "quats": 4, "features_dc": 3, "features_rest": 9, "opacities": 1}


@dataclass
class ModelConfig:
    _target: Any = None
    strategy: str = "default"


@dataclass
class OlderModelConfig:
    """As of 1.1.5, which has no strategies."""

    _target: Any = None


class Model(torch.nn.Module):
    """Splatfacto without a renderer."""

    def __init__(self, config: Any) -> None:
        super().__init__()
        self.config = config
        torch.manual_seed(0)
        values = {name: Parameter(torch.randn(6, width)) for name, width in WIDTHS.items()}
        self.gauss_params = torch.nn.ParameterDict(values)

    def get_training_callbacks(self, training_callback_attributes: Any) -> list:
        return ["splatfacto's own"]


@dataclass
class Spec:
    config: Any
    description: str


def method(name: str, model: Any) -> Any:
    pipeline = types.SimpleNamespace(model=model)
    return types.SimpleNamespace(method_name=name, pipeline=pipeline, max_num_iterations=TOTAL)


@pytest.fixture(params=["main", "1.1.5"])
def ours(request: Any, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The module opt3dgs_optim.hosts.nerfstudio, beside stand-ins of what it imports."""
    config = ModelConfig if request.param == "main" else OlderModelConfig
    bases = {"splatfacto": method("splatfacto", config())}
    if request.param == "main":
        bases["splatfacto-mcmc"] = method("splatfacto", ModelConfig(strategy="mcmc"))
    names = ("", ".models", ".models.splatfacto", ".configs", ".configs.method_configs")
    names += (".plugins", ".plugins.types")
    made: dict[str, Any] = {f"nerfstudio{n}": types.ModuleType(f"nerfstudio{n}") for n in names}
    made["nerfstudio.models.splatfacto"].SplatfactoModel = Model
    made["nerfstudio.models.splatfacto"].SplatfactoModelConfig = config
    made["nerfstudio.plugins.types"].MethodSpecification = Spec
    made["nerfstudio.configs.method_configs"].method_configs = bases
    for name, module in made.items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.delitem(sys.modules, "opt3dgs_optim.hosts.nerfstudio", raising=False)
    yield importlib.import_module("opt3dgs_optim.hosts.nerfstudio")
    sys.modules.pop("opt3dgs_optim.hosts.nerfstudio", None)


def set_up(
    ours: Any, spec: Any, accumulated: str = "camera_opt", *, resumed: bool = False
) -> tuple[Any, dict[str, torch.optim.Adam]]:
    """The model and the optimizers, when the trainer is set up."""
    model = ours.Opt3DGSSplatfactoModel(spec.config.pipeline.model)
    optimizers = {n: torch.optim.Adam([p], eps=1e-15) for n, p in model.gauss_params.items()}
    optimizers["camera_opt"] = torch.optim.Adam([Parameter(torch.zeros(1, 6))])
    if resumed:  # nerfstudio's model makes its Parameters anew where it loads a checkpoint
        for name, param in model.gauss_params.items():
            model.gauss_params[name] = Parameter(param.detach().clone())
    config = types.SimpleNamespace(max_num_iterations=TOTAL)
    config.gradient_accumulation_steps = {accumulated: 4}  # plain Adam's may be
    trainer = types.SimpleNamespace(config=config)
    held = types.SimpleNamespace(optimizers=optimizers)
    attributes = types.SimpleNamespace(optimizers=held, trainer=trainer)
    assert model.get_training_callbacks(attributes) == ["splatfacto's own"]
    return model, optimizers


@pytest.mark.parametrize("attribute", ["splatfacto_opt3dgs", "splatfacto_mcmc_opt3dgs"])
def test_the_optimizers_are_upgraded(ours: Any, attribute: str) -> None:
    spec = getattr(ours, attribute)
    model, optimizers = set_up(ours, spec)
    assert model.phases.parts == DEFAULTS
    for _ in range(TOTAL):
        for param in model.gauss_params.values():
            param.grad = torch.randn_like(param)
        for optimizer in optimizers.values():
            optimizer.step()
    assert model.phases.iteration == TOTAL - 1
    assert model.phases.end_line() is None  # it has ended, with the mean
    for name in WIDTHS:
        state = optimizers[name].state[model.gauss_params[name]]
        assert torch.equal(state["averaging.mean"], model.gauss_params[name]), name


def test_a_resumed_training_is_refused(ours: Any) -> None:
    with pytest.raises(ValueError, match="would not train them; train in one piece"):
        set_up(ours, ours.splatfacto_opt3dgs, resumed=True)


def test_accumulated_gradients_are_refused(ours: Any) -> None:
    with pytest.raises(ValueError, match=r"\{'scales': 4\} leave out steps of Gaussians"):
        set_up(ours, ours.splatfacto_opt3dgs, "scales")


def test_every_entry_point_is_a_method(ours: Any) -> None:
    """nerfstudio prints a warning of all else; the same method twice is one method."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    found = dict(
        re.findall(r'^(splatfacto[\w-]*) = "opt3dgs_optim\.hosts\.nerfstudio:(\w+)"', text, re.M)
    )
    assert set(found) == {"splatfacto-opt3dgs", "splatfacto-mcmc-opt3dgs"}
    specs = [getattr(ours, attribute) for attribute in found.values()]
    assert all(isinstance(spec, Spec) for spec in specs)
    methods = {spec.config.method_name: spec.config.pipeline.model for spec in specs}
    known = sys.modules["nerfstudio.configs.method_configs"].method_configs
    assert set(methods) == {f"{base}-opt3dgs" for base in known}
    for name, model in methods.items():
        base = known[name.removesuffix("-opt3dgs")].pipeline.model
        assert getattr(model, "strategy", None) == getattr(base, "strategy", None)
        assert model._target is ours.Opt3DGSSplatfactoModel
        assert base._target is None  # nerfstudio's own is as it was
    with pytest.raises(AttributeError, match="nerfacto"):
        _ = ours.nerfacto


def test_without_nerfstudio_the_import_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "opt3dgs_optim.hosts.nerfstudio", raising=False)
    monkeypatch.setitem(sys.modules, "nerfstudio", None)
    with pytest.raises(ImportError, match="pip install nerfstudio"):
        importlib.import_module("opt3dgs_optim.hosts.nerfstudio")
