"""The doctor finds a sound installation sound, and a broken one broken; the commands' own words."""

from __future__ import annotations

import re
from typing import Any

import pytest
import torch

from opt3dgs_optim import LQNAdam, __version__, doctor, step
from opt3dgs_optim import __main__ as commands

Said = pytest.CaptureFixture[str]


def test_a_sound_cpu(capsys: Said) -> None:
    """Each check, with what it compared and how far it was; and the versions."""
    assert doctor.main(["--device", "cpu"]) == 0
    said = capsys.readouterr().out
    assert re.search(rf"^opt3dgs_optim +{re.escape(__version__)}$", said, re.M)
    for line in ("python", "torch", "numpy", "triton", "device", "step", "curvature"):
        assert re.search(rf"^{line} +\S", said, re.M), line
    assert re.search(r"^  ok +Adam with all off: .* 0.0e\+00 \(limit 0e\+00\)$", said, re.M)
    assert re.search(r"^  ok +default step: 60 default steps differ from float64's", said, re.M)
    assert re.search(r"^  -- +kernels of the curvature: not run: ", said, re.M)


def light(monkeypatch: pytest.MonkeyPatch, *names: str) -> None:
    """Only these checks."""
    chosen = {name: doctor.CHECKS[name] for name in names}
    monkeypatch.setattr(doctor, "CHECKS", chosen)


@pytest.mark.parametrize("factor", [1 + 1e-6, float("nan")])
def test_another_step_is_found(
    monkeypatch: pytest.MonkeyPatch, capsys: Said, factor: float
) -> None:
    light(monkeypatch, "Adam with all off")
    real = LQNAdam.step

    def farther(self: Any, closure: Any = None) -> None:
        real(self, closure)
        for param in self.param_groups[0]["params"]:
            param.data *= factor

    monkeypatch.setattr(LQNAdam, "step", farther)
    assert doctor.main(["--device", "cpu"]) == 1
    said = capsys.readouterr().out
    assert "FAILED  Adam with all off: ArithmeticError: LQNAdam's first step differs" in said
    assert "1 of 1 FAILED: this installation gives wrong numbers" in said


def test_a_check_that_breaks_is_a_finding(monkeypatch: pytest.MonkeyPatch, capsys: Said) -> None:
    light(monkeypatch, "default step")

    def broken(*_: Any) -> Any:
        raise OSError("no such file")

    monkeypatch.setattr(step, "chosen_rows", broken)
    assert doctor.main(["--device", "cpu"]) == 1
    assert "FAILED  default step: OSError: no such file" in capsys.readouterr().out


@pytest.mark.parametrize("device", ["nowhere", "cuda:99"])
def test_a_device_that_torch_cannot_use(device: str, capsys: Said) -> None:
    assert doctor.main(["--device", device]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert re.fullmatch(rf"doctor: --device '{device}': torch cannot use it here: .+\n", said.err)


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no CUDA device")
def test_a_sound_gpu(capsys: Said) -> None:
    assert doctor.main(["--device", "cuda"]) == 0
    assert "  ok      default step" in capsys.readouterr().out


def test_the_commands(capsys: Said, monkeypatch: pytest.MonkeyPatch) -> None:
    light(monkeypatch)
    assert commands.main(["--version"]) == 0
    assert capsys.readouterr().out == f"{__version__}\n"
    assert commands.main([]) == 0
    usage = capsys.readouterr().out
    assert commands.main(["doctr"]) == 2
    assert f"opt3dgs: no command 'doctr'\n\n{usage}" == capsys.readouterr().err
    assert commands.main(["doctor", "--device", "cpu"]) == 0
    assert "Self-test" in capsys.readouterr().out

    def interrupted(*_: Any) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(doctor, "main", interrupted)
    assert commands.main(["doctor"]) == 130
