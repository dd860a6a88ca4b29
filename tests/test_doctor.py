"""The doctor finds a sound installation sound, and each kind of broken one broken."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from typing import Any

import pytest
import torch

from opt3dgs_optim import AWSGLD, EnergyHistogram, __version__, cuda, doctor, doctor_checks
from opt3dgs_optim import __main__ as commands
from opt3dgs_optim.doctor_checks import CHECKS, run_checks

CPU = torch.device("cpu")
LBFGS = sys.modules["opt3dgs_optim.lbfgs.two_loop"]  # the package has a function of that name


@pytest.fixture
def nothing_is_compiled(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    compiled: list[str] = []
    monkeypatch.setattr(cuda, "compile_cubin", lambda name, *_, **__: compiled.append(name))
    return compiled


def outcomes() -> dict[str, str]:
    return {check.name: check.outcome for check in run_checks(CPU)}


def test_a_sound_installation_passes() -> None:
    found = outcomes()
    assert list(found) == list(CHECKS)
    assert found.pop("CUDA kernels") == "skipped"
    assert set(found.values()) == {"ok"}


def turned(grad: Any, s: Any, y: Any) -> torch.Tensor:
    return RECURSION(grad, s, y) * (1 + 1e-8)


def not_a_number(grad: Any, s: Any, y: Any) -> torch.Tensor:
    return RECURSION(grad, s, y) * float("nan")


def farther(self: Any, closure: Any = None) -> None:
    STEP(self, closure)
    for param in self.param_groups[0]["params"]:
        param.data *= 1 + 1e-6


def heavier(self: Any) -> torch.Tensor:
    return WEIGHTS.__get__(self) * 1.001


def wrong_rotation(scales: Any, quats: Any, opacities: Any, eta: Any) -> torch.Tensor:
    return NOISE(scales, quats.roll(1, dims=1), opacities, eta)


def no_warm_up(self: Any, *args: Any, **options: Any) -> None:
    INIT(self, *args, **{**options, "warmup": 0})


RECURSION = LBFGS.recursion
STEP = AWSGLD.step
WEIGHTS = EnergyHistogram.weights
NOISE = doctor_checks.covariance_noise  # pyright: ignore[reportPrivateImportUsage]
INIT = EnergyHistogram.__init__


@pytest.mark.parametrize(
    ("place", "name", "broken", "caught"),
    [
        (LBFGS, "recursion", turned, "two-loop recursion"),
        (LBFGS, "recursion", not_a_number, "two-loop recursion"),
        (EnergyHistogram, "__init__", no_warm_up, "energy histogram"),
        (EnergyHistogram, "weights", property(heavier), "energy histogram"),
        (AWSGLD, "step", farther, "Adam with all off"),
        (doctor_checks, "covariance_noise", wrong_rotation, "covariance noise"),
    ],
)
@pytest.mark.usefixtures("nothing_is_compiled")
def test_a_broken_part_is_found(
    monkeypatch: pytest.MonkeyPatch, place: Any, name: str, broken: Callable[..., Any], caught: str
) -> None:
    monkeypatch.setattr(place, name, broken)
    assert [name for name, outcome in outcomes().items() if outcome == "failed"] == [caught]


def test_the_kernels_are_said_to_be_compiled_but_not_launched(
    nothing_is_compiled: list[str],
) -> None:
    check = run_checks(CPU)[-1]
    assert nothing_is_compiled == sorted(set(cuda.KERNELS.values()))
    assert check.outcome == "skipped"
    assert check.detail == "compiled for sm_80, not launched: the kernels need a CUDA device"


def test_a_compiler_that_breaks_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise OSError("no NVRTC")

    monkeypatch.setattr(cuda, "compile_cubin", fail)
    check = run_checks(CPU)[-1]
    assert check.outcome == "skipped"
    assert check.detail.startswith("not compiled (OSError: no NVRTC), not launched")


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no CUDA device")
def test_the_kernels_agree_with_torch_on_the_gpu() -> None:
    check = run_checks(torch.device("cuda", 0))[-1]
    assert check.outcome == ("ok" if cuda.missing() is None else "skipped"), check.detail


def test_doctor_as_a_command() -> None:
    call = [sys.executable, "-W", "error", "-m", "opt3dgs_optim", "doctor", "--device", "cpu"]
    done = subprocess.run(call, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    for text in (__version__, torch.__version__, "the kernels need a CUDA device"):
        assert text in done.stdout
    assert "In order: 4 checks passed, 1 could not be made here." in done.stdout


@pytest.mark.usefixtures("nothing_is_compiled")
def test_a_failure_is_the_exit_status(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(LBFGS, "recursion", turned)
    assert doctor.main(["--device", "cpu"]) == 1
    said = capsys.readouterr().out
    assert "FAILED  two-loop recursion: ArithmeticError: relative difference 1" in said
    assert "1 of 5 checks FAILED" in said


def test_what_is_wrong_is_said_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert doctor.main(["--device", "abacus"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("doctor: --device 'abacus': torch cannot use it here")
    assert error.count("\n") == 1


@pytest.mark.skipif(torch.cuda.is_available(), reason="torch sees a CUDA device")
def test_a_device_that_is_not_there(capsys: pytest.CaptureFixture[str]) -> None:
    assert doctor.main(["--device", "cuda"]) == 2
    assert "--device 'cuda': torch cannot use it here" in capsys.readouterr().err


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


def test_ctrl_c_ends_a_command_without_a_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(_arguments: Any) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(doctor, "main", interrupted)
    assert commands.main(["doctor"]) == 130
