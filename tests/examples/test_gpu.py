"""`gpu.py` on a CPU: it runs whole, says what it left out, and its device's side is simulated."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gpu
import numpy as np
import pytest
import torch
from splatting.colmap_writer import write_colmap
from splatting.scenes import load_scene
from studies.bench import gpu_training, steps
from studies.bench.subjects import SUBJECTS

CPU = torch.device("cpu")
SUMMARY = "SKIPPED [59] tests/cuda/test_cuda.py:1: torch sees no CUDA device\n{} in 0.10s\n"


def finished(code: int, output: str) -> tuple[subprocess.CompletedProcess[str], float]:
    return subprocess.CompletedProcess([], code, output), 1.5


@pytest.fixture
def checked(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """The doctor and the tests do not run; what they say is in here."""
    said = {"doctor": (0, "all is well"), "tests": (0, SUMMARY.format("3 passed, 59 skipped"))}

    def run(words: Sequence[str], _folder: Path) -> Any:
        return finished(*said["tests" if "pytest" in words else "doctor"])

    monkeypatch.setattr(gpu, "run", run)
    return said


def small(out: Path, *words: str) -> list[str]:
    return ["--device", "cpu", "--points", "64", "--repeats", "2", "-o", str(out), *words]


@pytest.mark.thorough
def test_all_of_it_runs_on_a_cpu(checked: dict[str, Any], tmp_path: Path) -> None:
    assert gpu.main(small(tmp_path)) == 0
    made = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    rows = made["steps"]["64"]
    assert {steps.BASELINE, *gpu.STEPPED} == set(rows) <= set(SUBJECTS)
    # Two moments of 59 numbers; six step counts beside them.
    assert 472 <= rows["six Adams again"]["bytes_per_point"] < 472 + 2
    assert rows["two-loop, [N, 3] in and out"]["waits"] == 0
    measured = [rows[name] for name in gpu.STEPPED]
    assert all(row["ns_low"] <= row["ns_per_point"] <= row["ns_high"] for row in measured)
    assert rows[steps.BASELINE]["per_adam"] == 1.0
    assert made["checks"]["tests"]["passed"] == 3
    page = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert gpu.CPU_NOTE in page
    assert "python examples/gpu.py --device cpu --points 64" in page
    assert "3 passed, 0 failed, 0 error, 59 skipped" in page
    assert "Skipped: torch sees no CUDA device." in page
    assert "Not run: --gsplat PATH/examples/simple_trainer.py was not given." in page
    assert re.search(r"\| defaults \| [\d.e+]+ ns, x[\d.]+ \([\d.]+ to [\d.]+\) \|", page)
    assert (tmp_path / "step.png").stat().st_size > 10_000


def test_what_fails_is_in_the_report_and_in_the_exit_status(
    checked: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checked["tests"] = 1, SUMMARY.format("2 failed, 1 passed, 59 skipped")
    row = {"ns_per_point": 1e4, "per_adam": 1.0, "adam_low": 1.0, "adam_high": 1.0, "waits": 0}
    row |= {"launches": 6, "operators": 30, "peak_bytes": 128, "bytes_per_point": 472.0}
    rows = {"defaults": row, "six Adams again": {"skipped": "out of memory"}}
    monkeypatch.setattr(gpu, "measure_all", lambda *_: rows)
    monkeypatch.setattr(gpu, "draw", lambda *_: False)
    assert gpu.main(small(tmp_path)) == 1
    page = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert "1 passed, 2 failed" in page
    assert "| six Adams again | not run: out of memory |" in page
    assert "| defaults | 1e+04 ns, x1.00 (1.00 to 1.00) |" in page
    assert "| defaults | 64 | 6 | 0 | 472 | 2 | - |" in page
    assert "No picture: matplotlib is not installed." in page
    assert (
        "2 failed"
        in json.loads((tmp_path / "report.json").read_text())["checks"]["tests"]["output"]
    )


def test_without_pytest_or_matplotlib_it_says_so(
    checked: dict[str, Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(gpu.importlib.util, "find_spec", lambda _name: None)
    assert gpu.check(CPU)["tests"] == {
        "skipped": "pytest is not installed: pip install -e '.[test]'"
    }
    assert not steps.draw({}, "", tmp_path / "none.png")
    arguments = SimpleNamespace(gsplat=tmp_path)
    assert "pip install gsplat" in gpu.training(arguments, CPU)["skipped"]  # pyright: ignore


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--device", "cuda"], "torch sees no CUDA device"),
        (["--gsplat", "nowhere.py"], "nowhere.py: no such file"),
    ],
)
def test_bad_calls_say_what_is_wrong(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    if "cuda" in words and torch.cuda.is_available():
        pytest.skip("torch sees a CUDA device")
    assert gpu.main([*words, "-o", str(tmp_path)]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.processes
def test_the_doctor_and_the_tests_really_run() -> None:
    made = gpu.check(CPU)
    assert made["doctor"]["code"] == 0
    assert "Self-test" in made["doctor"]["output"]
    assert made["tests"]["code"] in (0, 5)
    assert made["tests"]["failed"] == made["tests"]["error"] == 0
    assert made["tests"]["passed"] + made["tests"]["skipped"] > 20


def simulate(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """torch.cuda's calls of the device's side, which are noted; 128 bytes more at the peak."""
    calls: list[str] = []

    def note(name: str, value: Any = None) -> None:
        monkeypatch.setattr(
            torch.cuda, name, lambda *args: calls.append(f"{name}{args[:1]}") or value
        )

    for name in ("synchronize", "reset_peak_memory_stats", "set_sync_debug_mode", "empty_cache"):
        note(name)
    note("memory_allocated", 1_000)
    note("max_memory_allocated", 1_128)
    return calls


def test_launches_waits_and_memory_on_a_simulated_device(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = simulate(monkeypatch)
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
        warnings.simplefilter("ignore")  # of the calls whose warnings nobody counts
        counted = steps.count(call, device)
    assert counted == {"operators": 0, "launches": 2, "waits": 1, "peak_bytes": 128}
    modes = [name for name in calls if name.startswith("set_sync_debug_mode")]
    assert modes == ["set_sync_debug_mode('warn',)", "set_sync_debug_mode('default',)"]
    assert steps.bytes_in_use(device) == 1_000
    steps.release(device)
    assert calls[-1].startswith("empty_cache")


def test_a_gpus_name_and_size_are_in_the_report(monkeypatch: pytest.MonkeyPatch) -> None:
    found = SimpleNamespace(name="A GPU", major=9, minor=0, total_memory=1, multi_processor_count=2)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda _device: found)
    monkeypatch.setattr(gpu, "versions", lambda _device: {"torch": "2"})
    device: Any = SimpleNamespace(type="cuda")
    known = gpu.about(device, [])
    assert known["gpu"]["name"] == "A GPU"
    assert known["gpu"]["compute_capability"] == "9.0"


def test_a_value_that_is_read_is_a_wait() -> None:
    counted = steps.count(lambda: torch.ones(()).add(1).item(), CPU)
    assert counted == {"operators": 3, "waits": 1}


@pytest.mark.thorough
def test_a_subject_too_large_for_the_memory_is_skipped(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(_case: object) -> Any:
        raise torch.OutOfMemoryError("out of memory\nand so on")

    monkeypatch.setitem(SUBJECTS, "defaults", fails)
    made = steps.measure_all(16, CPU, ["defaults", "six Adams again"], 1)
    assert made["defaults"] == {"skipped": "out of memory"}
    assert made["six Adams again"]["ns_per_point"] > 0
    with pytest.raises(ValueError, match="none of defaults could be measured at 16"):
        steps.measure_all(16, CPU, ["defaults"], 1)


def test_the_embedded_scene_in_colmaps_layout(tmp_path: Path) -> None:
    scene = load_scene("embedded")
    write_colmap(scene, tmp_path)
    read = load_scene(tmp_path, "images")
    assert len(read.test) == len(scene.test)
    assert len(read.train) == len(scene.train)
    for kind in ("train", "test"):
        for one, other in zip(getattr(scene, kind), getattr(read, kind), strict=True):
            assert torch.allclose(one.camera.viewmat, other.camera.viewmat, atol=1e-5)
            assert one.camera.fx == pytest.approx(other.camera.fx)
            # Eight bits a channel.
            assert float((one.image.clamp(0, 1) - other.image).abs().max()) <= 0.5 / 255 + 1e-6
    assert np.allclose(scene.points, read.points, atol=1e-6)
    assert read.extent == pytest.approx(scene.extent, rel=1e-5)


@pytest.mark.thorough
def test_a_scene_with_too_few_test_views_is_refused(tmp_path: Path) -> None:
    scene = load_scene("embedded")
    del scene.test[1:]
    with pytest.raises(ValueError, match="24 views to train on and 1 to judge by"):
        write_colmap(scene, tmp_path)


def test_both_trainings_of_gsplats_script(
    checked: dict[str, Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The script and its process are stand-ins; `pytest -m hosts` runs the real one."""
    pytest.importorskip("gsplat")
    script = tmp_path / "gsplat" / "simple_trainer.py"
    script.parent.mkdir()
    script.write_text("stock", encoding="utf-8")
    monkeypatch.setattr(gpu_training, "write", lambda path: path.write_text("ours"))
    calls: list[list[str]] = []

    def run(words: list[str], folder: Path) -> Any:
        calls.append(words)
        text = next(Path(w).read_text() for w in words if w.endswith("simple_trainer.py"))
        stats = folder.parent / "stats"
        stats.mkdir(parents=True)
        (stats / "val_step0029.json").write_text(json.dumps({"psnr": len(text), "lpips": 1.0}))
        (stats / "train_step0029_rank0.json").write_text(json.dumps({"ellipse_time": 2.5}))
        return finished(0, "PSNR: 9.125, SSIM: 0.5")

    monkeypatch.setattr(gpu_training, "run", run)
    monkeypatch.setattr(gpu, "measure_all", lambda *_: {"copy": COPY})
    assert gpu.main(small(tmp_path / "out", "--gsplat", str(script))) == 0
    made = json.loads((tmp_path / "out" / "report.json").read_text())["training"]
    assert made["stock"] == {"psnr": 5, "seconds": 1.5, "training_seconds": 2.5}
    assert made["ours"]["psnr"] == 4
    assert script.read_text(encoding="utf-8") == "stock"  # the copy was edited
    assert all(words[0].endswith("on_cpu.py") for words in calls)
    assert calls[0][2:4] == ["mcmc", "--data_dir"]
    assert (Path(calls[0][4]) / "sparse" / "0" / "images.bin").is_file()
    page = (tmp_path / "out" / "report.md").read_text(encoding="utf-8")
    assert "| stock | 5 | - | 2.5 | 1.5 | - | - |" in page

    monkeypatch.setattr(gpu_training, "run", lambda *_: finished(1, "a\nImportError: no tyro\n"))
    found = gpu_training.train(script, tmp_path, tmp_path / "bad", 3_000, 10, cpu=False)
    assert found == {"skipped": "ImportError: no tyro", "seconds": 1.5}


COPY = {
    **{"ns_per_point": 1.0, "ns_low": 1.0, "ns_high": 1.0, "waits": 0, "operators": 1},
    **{"per_adam": 1.0, "adam_low": 1.0, "adam_high": 1.0, "bytes_per_point": 288.0},
    "gb_per_second": 7.0,
}


def test_a_script_is_run_with_its_output_kept(tmp_path: Path) -> None:
    words = ["-c", "import os, sys; print(os.getcwd()); sys.exit(3)"]
    done, seconds = gpu_training.run(words, tmp_path / "new")
    assert done.returncode == 3
    assert done.stdout.strip() == str((tmp_path / "new").resolve())
    assert seconds > 0
    assert sys.executable == done.args[0]
