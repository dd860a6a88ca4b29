"""Which backend runs, and why not the other: nothing changes silently."""

from __future__ import annotations

import importlib.machinery
import importlib.util
import re

import pytest
import torch

from opt3dgs_optim import LQNAdam, backend_info, cuda
from opt3dgs_optim.backend import obstacle


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch):
    """A machine with everything there, from which a test takes one thing away."""

    def imported(there: bool) -> object:
        if not there:
            raise ModuleNotFoundError("No module named 'cuda'")
        return object()

    def build(*, core: bool = True, hip: str | None = None, gpu: bool = True) -> None:
        cuda.missing.cache_clear()
        monkeypatch.setattr(importlib, "import_module", lambda name: imported(core))
        monkeypatch.setattr(torch.version, "hip", hip)
        monkeypatch.setattr(torch.cuda, "is_available", lambda: gpu)

    yield build
    cuda.missing.cache_clear()


def test_a_gpu_with_everything_runs_the_kernels(machine) -> None:
    machine()
    info = backend_info()
    assert (info.backend, info.device) == ("cuda", "cuda")
    assert backend_info("cuda:3", torch.float64, backend="cuda").backend == "cuda"
    assert obstacle("auto", torch.device("cuda", 1), torch.float32) is None


@pytest.mark.parametrize(
    ("absent", "sentence"),
    [
        (
            {"core": False},
            r"cuda\.core is not installed \(pip install 'opt3dgs_optim\[cuda(12)?\]'\)",
        ),
        ({"hip": "6.4"}, "built for ROCm"),
        ({"gpu": False}, "torch sees no CUDA device"),
    ],
    ids=["no cuda.core", "ROCm", "no driver"],
)
def test_what_is_missing_is_named(machine, absent: dict, sentence: str) -> None:
    machine(**absent)
    info = backend_info("cuda")
    assert info.backend == "torch"
    assert re.search(sentence, info.reason)
    assert re.search(sentence, repr(info))
    with pytest.raises(RuntimeError, match=sentence):
        backend_info("cuda", backend="cuda")
    assert obstacle("auto", torch.device("cuda"), torch.float32)


def test_a_broken_cuda_core_is_named(machine, monkeypatch: pytest.MonkeyPatch) -> None:
    machine()

    def broken(name: str) -> object:
        raise ImportError("libcuda.so.1: cannot open shared object file")

    monkeypatch.setattr(importlib, "import_module", broken)
    assert "ImportError: libcuda.so.1" in backend_info("cuda").reason


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_other_precisions_run_in_torch(machine, dtype: torch.dtype) -> None:
    machine()
    assert str(dtype).removeprefix("torch.") in backend_info("cuda", dtype).reason


@pytest.mark.parametrize("device", ["cpu", "mps", "xpu"])
def test_other_devices_run_in_torch(device: str) -> None:
    info = backend_info(device)
    assert info.backend == "torch"
    assert repr(info) == (
        f"BackendInfo(device='{device}', dtype=torch.float32, backend='torch', "
        "reason='the kernels need a CUDA device')"
    )


def test_torch_can_be_insisted_on(machine) -> None:
    machine()
    assert backend_info("cuda", backend="torch").reason == "backend='torch' was asked for"
    assert obstacle("torch", torch.device("cuda"), torch.float32)


def test_cuda_on_a_cpu_is_one_clear_error() -> None:
    x = torch.nn.Parameter(torch.ones(4, 3))
    x.grad = torch.ones_like(x)
    with pytest.raises(RuntimeError, match="backend='cuda' was asked for on cpu"):
        LQNAdam([x], backend="cuda").step()
