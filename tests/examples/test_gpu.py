"""`gpu.py` on a CPU: it runs whole, and its device's side is simulated."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gpu
import pytest
import torch
from benchmarks import steps


@pytest.fixture
def said(monkeypatch: pytest.MonkeyPatch) -> dict[str, tuple[int, str]]:
    """What the processes say that it starts; the doctor and the tests do not run."""
    answers = {"doctor": (0, "all is well"), "pytest": (0, "3 passed")}

    def run(words: Any) -> tuple[int, str, float]:
        return (*answers[next(k for k in answers if k in words)], 1.5)

    monkeypatch.setattr(gpu, "run", run)
    return answers


def small(out: Path, *words: str) -> list[str]:
    return ["--device", "cpu", "--points", "64", "--rounds", "2", "-o", str(out), *words]


def test_all_of_it_runs_on_a_cpu(said: dict[str, tuple[int, str]], tmp_path: Path) -> None:
    assert gpu.main(small(tmp_path)) == 0
    made = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert set(made["steps"]["results"]["64"]) == set(steps.SUBJECTS)
    page = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert "## doctor: exit status 0\n\n```text\nall is well\n" in page
    assert "| defaults | - | - | " in page
    assert page.count("`two_loop` of 64 points with 5 pairs: ") == 1
    assert made["failed"] == {}
    said["pytest"] = 1, "2 failed"
    assert gpu.main(small(tmp_path)) == 1
    assert "2 failed" in (tmp_path / "report.md").read_text(encoding="utf-8")


def test_a_measurement_that_fails_loses_no_other(
    said: dict[str, tuple[int, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    measure = steps.measure

    def measured(points: int, *others: Any) -> Any:
        if points > 64:
            raise torch.cuda.OutOfMemoryError("no room")
        assert "all is well" in (tmp_path / "report.md").read_text(encoding="utf-8")
        return measure(points, *others)

    monkeypatch.setattr(steps, "measure", measured)
    assert gpu.main([*small(tmp_path), "--points", "64", "128"]) == 1
    page = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert "| defaults | - | - | " in page
    assert "steps, 128: OutOfMemoryError: no room" in page


def test_without_a_gpu_it_says_so(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert gpu.main([]) == 2
    assert "torch sees no CUDA device" in capsys.readouterr().err


def test_a_process_is_run_with_its_output_kept() -> None:
    words = ["-c", "import os, sys; print(os.getcwd()); sys.exit(3)"]
    code, printed, seconds = gpu.run(words)
    assert (code, printed.strip()) == (3, str(gpu.ROOT))
    assert 0.0 <= seconds < 60.0


def test_launches_waits_and_memory_on_a_simulated_device(monkeypatch: pytest.MonkeyPatch) -> None:
    modes: list[str] = []
    for name, value in (("memory_allocated", 1_000), ("max_memory_allocated", 1_128)):
        monkeypatch.setattr(torch.cuda, name, lambda _device, value=value: value)
    for name in ("synchronize", "reset_peak_memory_stats"):
        monkeypatch.setattr(torch.cuda, name, lambda _device: None)
    monkeypatch.setattr(torch.cuda, "set_sync_debug_mode", modes.append)
    events = [
        SimpleNamespace(name="adam_kernel", device_type="DeviceType.CUDA"),
        SimpleNamespace(name="Memcpy HtoD", device_type="DeviceType.CUDA"),
        SimpleNamespace(name="Optimizer.step#Adam.step", device_type="DeviceType.CUDA"),
        SimpleNamespace(name="aten::mul", device_type="DeviceType.CPU"),
    ]

    class Profiler:
        def __init__(self, activities: Any) -> None:
            assert len(activities) == 2

        def __enter__(self) -> Any:
            return SimpleNamespace(events=lambda: events)

        def __exit__(self, *_: object) -> None: ...

    def call() -> None:
        warnings.warn("called a synchronizing CUDA operation", stacklevel=2)
        warnings.warn("something else", stacklevel=2)

    monkeypatch.setattr(steps, "profile", Profiler)
    device: Any = SimpleNamespace(type="cuda")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the second call, whose warnings nobody counts
        found = steps.counts(call, device)
    assert found == {"launches": 2, "waits": 1, "peak_bytes": 128}
    assert modes == ["warn", "default"]
