"""The doctor finds a sound installation sound, and each kind of broken one broken."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import pytest
import torch

from opt3dgs_optim import (
    AWSGLD,
    EnergyHistogram,
    LQNAdam,
    __version__,
    cuda,
    curvature,
    doctor,
    doctor_checks,
    doctor_costs,
)
from opt3dgs_optim import __main__ as commands
from opt3dgs_optim._status import CLEAR, StatusLine
from opt3dgs_optim.doctor_checks import CHECKS, run_checks
from opt3dgs_optim.noise import covariance_noise

CPU = torch.device("cpu")


def outcomes() -> dict[str, str]:
    return {check.name: check.outcome for check in run_checks(CPU, lambda _name: None)}


def test_a_sound_installation_passes() -> None:
    found = outcomes()
    assert list(found) == list(CHECKS)
    assert found.pop("CUDA kernels") == "skipped"
    assert set(found.values()) == {"ok"}


def turned(grad: torch.Tensor, history: torch.Tensor, size: int) -> torch.Tensor:
    return TWO_LOOP(grad, history, size) * (1 + 1e-8)


def no_warm_up(self: Any, nu: torch.Tensor) -> torch.Tensor:
    return nu


def heavier(self: Any, index: torch.Tensor, valid: torch.Tensor) -> None:
    UPDATE(self, index, valid)
    self._weights.mul_(1.001)


def slower(self: Any, group: Any, device: Any) -> Any:
    return group["lr"] * (1 + 1e-6)


def wrong_rotation(scales: Any, quats: Any, opacities: Any, eta: Any) -> torch.Tensor:
    return NOISE(scales, quats.roll(1, dims=1), opacities, eta)


TWO_LOOP = curvature.two_loop
UPDATE = EnergyHistogram._update_weights
NOISE = covariance_noise


@pytest.mark.parametrize(
    ("place", "name", "broken", "caught"),
    [
        (curvature, "two_loop", turned, ["two-loop recursion", "secant equation"]),
        (EnergyHistogram, "_warmed_up", no_warm_up, ["energy histogram"]),
        (EnergyHistogram, "_update_weights", heavier, ["energy histogram"]),
        (AWSGLD, "_scaled_lr", slower, ["Adam with all off"]),
        (LQNAdam, "_scaled_lr", slower, ["Adam with all off"]),
        (doctor_checks, "covariance_noise", wrong_rotation, ["covariance noise"]),
    ],
)
def test_a_broken_part_is_found(
    monkeypatch: pytest.MonkeyPatch,
    place: Any,
    name: str,
    broken: Callable[..., Any],
    caught: list[str],
) -> None:
    monkeypatch.setattr(place, name, broken)
    assert [name for name, outcome in outcomes().items() if outcome == "failed"] == caught


def test_nan_is_no_small_difference(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(curvature, "two_loop", lambda g, _h, _k: g * float("nan"))
    assert outcomes()["two-loop recursion"] == "failed"


def test_the_kernels_are_said_to_be_compiled_or_not_but_never_launched(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    compiled = []
    monkeypatch.setattr(doctor_checks, "_has_cuda_core", lambda: True)
    monkeypatch.setattr(cuda, "compile_cubin", lambda name, *_, **__: compiled.append(name))
    check = run_checks(CPU, lambda _name: None)[-1]
    assert compiled == list(cuda.KERNELS)
    assert check.outcome == "skipped"
    assert check.detail.startswith("compiled for sm_80 in ")
    assert check.detail.endswith("but not launched: the kernels need a CUDA device")
    monkeypatch.setattr(doctor_checks, "_has_cuda_core", lambda: False)
    check = run_checks(CPU, lambda _name: None)[-1]
    assert check.outcome == "skipped"
    assert check.detail.startswith("not compiled, not launched: ")
    assert "cuda.core is not installed" in check.detail


def test_a_compiler_that_breaks_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise OSError("no NVRTC")

    monkeypatch.setattr(doctor_checks, "_has_cuda_core", lambda: True)
    monkeypatch.setattr(cuda, "compile_cubin", fail)
    check = run_checks(CPU, lambda _name: None)[-1]
    assert check.outcome == "skipped"
    assert check.detail.startswith("not compiled (OSError: no NVRTC), not launched")


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no CUDA device")
def test_the_kernels_agree_with_torch_on_the_gpu() -> None:
    check = run_checks(torch.device("cuda", 0), lambda _name: None)[-1]
    assert check.outcome == ("ok" if cuda.missing() is None else "skipped"), check.detail


def test_costs_are_positive_and_their_bytes_are_those_of_the_tensors() -> None:
    costs = {cost.name: cost for cost in doctor_costs.measure(CPU, 1000, lambda _name: None)}
    assert list(costs) == list(doctor_costs.SUBJECTS)
    assert all(cost.ns_per_point > 0 for cost in costs.values())
    numbers = 3 + 3 + 4 + 1 + 3 + 45
    adam, noise = numbers * 4 * 7, 4 * (3 + 4 + 1 + 3 * 3)
    assert costs["six torch Adams"].bytes_kept == numbers * 8
    assert costs["six torch Adams"].bytes_moved == adam
    assert costs["noise"].bytes_moved == noise
    assert costs["exploration step"].bytes_kept == numbers * 8  # nu and noise keep nothing
    assert costs["exploration step"].bytes_moved == adam + noise
    history = 5 * 8 * 4
    assert costs["exploitation step"].bytes_kept == numbers * 8 + history
    assert costs["exploitation step"].bytes_moved == adam + noise + 2 * history
    assert costs["pair and two-loop"].bytes_moved == 2 * history + 3 * 12
    assert costs["two-loop, pure torch"].bytes_moved == history + 2 * 12


def test_the_measured_exploitation_step_takes_pairs() -> None:
    """Gradients that never change would leave the history empty, and the step too cheap."""
    subject = doctor_costs._step(500, CPU, exploit=True)
    for _ in range(4):
        subject.call()
    assert subject.count()[0] == 500 * (59 * 8 + 160)


def command(*words: str) -> subprocess.CompletedProcess[str]:
    call = [sys.executable, "-W", "error", "-m", "opt3dgs_optim", *words]
    return subprocess.run(call, capture_output=True, text=True, check=False)


def test_doctor_as_a_command() -> None:
    done = command("doctor", "--points", "1000", "--device", "cpu")
    assert (done.returncode, done.stderr) == (0, "")
    for text in (__version__, torch.__version__, "the kernels need a CUDA device", "exploration"):
        assert text in done.stdout
    assert "In order: 5 checks passed, 1 could not be made here." in done.stdout


def test_doctor_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert doctor.main(["--json", "--points", "500", "--device", "cpu"]) == 0
    found = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert found["passed"] is True
    assert found["versions"]["opt3dgs_optim"] == __version__
    assert found["backend"] == {
        "in_use": "torch",
        "reason": "the kernels need a CUDA device",
        "advice": None,
    }
    assert [check["name"] for check in found["checks"]] == list(CHECKS)
    assert [cost["name"] for cost in found["costs"]] == list(doctor_costs.SUBJECTS)
    assert 0 < found["self_test_seconds"] < 60


def test_a_failure_is_the_exit_status(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(curvature, "two_loop", turned)
    assert doctor.main(["--points", "0", "--device", "cpu"]) == 1
    said = capsys.readouterr().out
    assert "FAILED  two-loop recursion: ArithmeticError: relative difference 1" in said
    assert "2 of 6 checks FAILED" in said
    assert "Cost per million" not in said
    assert doctor.main(["--json", "--points", "0", "--device", "cpu"]) == 1
    assert json.loads(capsys.readouterr().out)["passed"] is False


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--points", "-1"], "--points -1: must be 0 or more"),
        (["--device", "abacus"], "--device 'abacus': torch cannot use it here"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert doctor.main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"doctor: {message}")
    assert error.count("\n") == 1


@pytest.mark.skipif(torch.cuda.is_available(), reason="torch sees a CUDA device")
def test_a_device_that_is_not_there(capsys: pytest.CaptureFixture[str]) -> None:
    assert doctor.main(["--device", "cuda"]) == 2
    assert "--device 'cuda': torch cannot use it here" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("version", "advice"),
    [
        ("12.1", "pip install 'opt3dgs_optim[cuda12]'"),
        ("13.0", "pip install 'opt3dgs_optim[cuda]'"),
        (None, None),
    ],
)
def test_advice_on_a_gpu_without_cuda_core(
    version: str | None, advice: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.version, "cuda", version)
    monkeypatch.setattr(doctor, "_installed", lambda _name: None)
    assert doctor.advice(torch.device("cuda")) == advice
    assert doctor.advice(CPU) is None


def test_commands_are_listed_and_found(capsys: pytest.CaptureFixture[str]) -> None:
    assert commands.main([]) == 0
    listed = capsys.readouterr().out
    for name in ("doctor", "report", "hosts"):
        assert f"  {name} " in listed
        with pytest.raises(SystemExit) as stop:
            commands.main([name, "--help"])
        assert stop.value.code == 0
        assert "usage:" in capsys.readouterr().out
    assert commands.main(["--version"]) == 0
    assert capsys.readouterr().out == f"{__version__}\n"
    assert commands.main(["doktor"]) == 2
    assert "no command 'doktor'" in capsys.readouterr().err
    assert commands.main(["hosts", "diff", "no_such_file.py"]) == 1


def test_ctrl_c_ends_a_command_without_a_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(_arguments: Any) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(doctor, "main", interrupted)
    assert commands.main(["doctor"]) == 130


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_progress_is_for_terminals_only() -> None:
    for stream, expected in ((Terminal(), f"{CLEAR}half way{CLEAR}"), (io.StringIO(), "")):
        line = StatusLine(stream)
        line.show("half way")
        line.clear()
        assert stream.getvalue() == expected
    screen = Terminal()
    doctor.examine(CPU, 100, StatusLine(screen))
    for name in (*CHECKS, *doctor_costs.SUBJECTS):
        assert f": {name}" in screen.getvalue()
    assert screen.getvalue().endswith(CLEAR)
