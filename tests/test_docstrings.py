"""Public docstrings: their examples run, and they say arguments, shapes, errors and memory."""

from __future__ import annotations

import doctest
import importlib
import inspect
import pkgutil
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import opt3dgs_optim

MODULES = [name for _, name, _ in pkgutil.walk_packages(opt3dgs_optim.__path__, "opt3dgs_optim.")]


@pytest.mark.parametrize("name", [name for name in MODULES if not name.endswith("__main__")])
def test_examples_run(name: str) -> None:
    if name in ("opt3dgs_optim.hosts.nerfstudio", "opt3dgs_optim.hosts.lightning"):
        pytest.importorskip("nerfstudio", reason="nerfstudio is not installed: its users' module")
    result = doctest.testmod(importlib.import_module(name))
    assert result.failed == 0


@pytest.mark.parametrize("name", ["AWSGLD", "LQNAdam", "PhaseScheduler"])
def test_the_main_classes_have_one(name: str) -> None:
    assert ">>>" in getattr(opt3dgs_optim, name).__doc__


API = (Path(__file__).resolve().parents[1] / "docs" / "api.md").read_text(encoding="utf-8")
# Their arguments stand in one sentence.
SENTENCES = ("read_run", "find_logs", "diff", "write", "paper_parts", "Run.series")
SENTENCES += ("RunLog.resume", "RunLog.step", "RunLog.evaluation", "RunLog.event")
SENTENCES += ("PositionNoise.add_to", "Fading.chosen", "Course.phase_of", "Course.part")
SENTENCES += ("StepAdam.acts_on", "PhaseScheduler.part")
SENTENCES += tuple(f"{name}.load_state_dict" for name in ("StepAdam", "EnergyHistogram"))
HOOKS = (
    "ready",
    "window",
    "displacement",
    "factor",
    "before",
    "after",
    "pixel_loss",
    "numbers",
    "load_state_dict",
)
SENTENCES += tuple(f"Part.{hook}" for hook in (*HOOKS, "observe", "evidence", "useless"))
SENTENCES += ("PhaseScheduler.paper", "PhaseScheduler.pixel_loss", "StepAdam.follow")
ELSEWHERE = ("Phase", "StepAdam", "BackendInfo")  # nothing to pass; torch's own arguments


def of_the_reference() -> dict[str, Callable[..., Any]]:
    """The classes, methods and functions on the API page."""
    found = {}
    for block in re.split(r"^::: ", API, flags=re.M)[1:]:
        path = block.split()[0]
        module, _, name = path.rpartition(".")
        if module in ("opt3dgs_optim.hosts.nerfstudio", "opt3dgs_optim.hosts.lightning"):
            continue
        item = getattr(importlib.import_module(module), name)
        if callable(item):
            found[name] = item
        for names in re.findall(r"members: \[(.*)\]", block):
            for member in filter(None, names.split(", ")):
                value = inspect.getattr_static(item, member)
                value = getattr(value, "__func__", value)
                found[f"{name}.{member}"] = value.fget if isinstance(value, property) else value
    return found


REFERENCE = of_the_reference()
assert len(REFERENCE) > 60


def arguments(call: Callable[..., Any]) -> list[inspect.Parameter]:
    found = inspect.signature(inspect.unwrap(call)).parameters.values()
    return [each for each in found if each.name not in ("self", "cls")]


def explained(doc: str) -> dict[str, str]:
    """What a docstring says under "Args:", by argument."""
    section = re.search(r"^(?:Args|Attributes):\n((?: .*\n|\n)*)", doc + "\n", re.M)
    entries = re.split(r"^    (?=\w[\w, ]*: )", section[1] if section else "", flags=re.M)
    pairs = (entry.partition(": ")[::2] for entry in entries)
    return {name: text for names, text in pairs for name in names.split(", ")}


@pytest.mark.parametrize("name", REFERENCE)
def test_every_argument_is_explained(name: str) -> None:
    doc = inspect.getdoc(REFERENCE[name])
    assert doc
    if name in (*ELSEWHERE, *SENTENCES):
        return
    missing = {each.name for each in arguments(REFERENCE[name])} - set(explained(doc))
    assert missing <= {"overrides"}, name


@pytest.mark.parametrize("name", REFERENCE)
def test_every_tensor_has_a_shape(name: str) -> None:
    """Brackets, or a word that says it: 0-d, images of one shape."""
    texts = explained(inspect.getdoc(REFERENCE[name]) or "")
    for each in arguments(REFERENCE[name]) if name not in ELSEWHERE else ():
        tensor = re.search(r"(?<!Gaussian)Tensor\b(?! \| None = None)", str(each.annotation))
        if (
            tensor
            and each.name in texts
            and each.name not in ("lr", "closure", "visibility", "valid")
        ):
            assert re.search(r"\[|0-d|shape", texts[each.name]), f"{name}: {each.name}"


@pytest.mark.parametrize("name", REFERENCE)
def test_every_error_is_announced(name: str) -> None:
    """Of what raises by itself, not through another call; a class says it of its options."""
    source = inspect.getsource(inspect.unwrap(REFERENCE[name]))
    doc = inspect.getdoc(REFERENCE[name]) or ""
    raises = re.findall(r"raise (\w+Error)", source) if not inspect.isclass(REFERENCE[name]) else []
    for error in set(raises) - {"NotImplementedError"}:  # a hook that nobody has is never called
        assert error in doc, f"{name} raises {error}"


@pytest.mark.parametrize("name", ["Curvature", "PhaseScheduler"])
def test_what_keeps_something_per_point_says_how_much(name: str) -> None:
    assert re.search(r"^\s*Memory: ", getattr(opt3dgs_optim, name).__doc__, re.M)
