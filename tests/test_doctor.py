"""The doctor finds a sound installation sound, and each kind of broken one broken."""

from __future__ import annotations

import itertools
import re
import subprocess
import sys
from typing import Any

import pytest
import torch
from kernel_host import compiler, host_kernels
from torch import Tensor

from opt3dgs_optim import AWSGLD, EnergyHistogram, __version__, cuda, doctor
from opt3dgs_optim import __main__ as commands

COMPARED = [name for name in cuda.KERNELS if name != "take_energy"]  # that one is compared below
STEP = AWSGLD.step
OUTPUTS = {"lqn_direction": 3}  # the argument; of the others the last tensor
KERNELS_OF = {  # each comparison: the kernels in it
    "lqn_direction": ["lqn_direction"],
    "two_loop": ["two_loop"],
    "own_frame": ["own_frame_gradient", "own_frame_displacement"],
}


@pytest.mark.parametrize("factor", [1 + 1e-6, float("nan")])
def test_another_step_is_found(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], factor: float
) -> None:
    def farther(self: Any, closure: Any = None) -> None:
        STEP(self, closure)
        for param in self.param_groups[0]["params"]:
            param.data *= factor

    monkeypatch.setattr(AWSGLD, "step", farther)
    assert doctor.main(["--device", "cpu"]) == 1
    said = capsys.readouterr().out
    assert "  FAILED  Adam with all off: ArithmeticError: AWSGLD with nothing on differs" in said
    assert "1 of 3 FAILED" in said


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no CUDA device")
def test_the_kernels_agree_with_torch_on_the_gpu(capsys: pytest.CaptureFixture[str]) -> None:
    assert doctor.main(["--device", "cuda"]) == 0
    mark = "ok" if cuda.missing() is None else "--"
    said = capsys.readouterr().out
    for check in ("CUDA kernels", "histogram on CUDA"):
        assert f"  {mark:<7} {check}" in said


@pytest.mark.compiles
@pytest.mark.skipif(compiler() is None, reason="g++ is not installed")
@pytest.mark.parametrize("broken", ["", *COMPARED])
def test_each_kernel_is_compared(monkeypatch: pytest.MonkeyPatch, broken: str) -> None:
    """The host plays the GPU, and breaks the result of one kernel."""

    def launch(kernel: str, like: Tensor, threads: int, *arguments: Any, **options: Any) -> None:
        host_kernels(doctor.HISTORY_SIZE, like.dtype).launch(
            kernel, like, threads, *arguments, **options
        )
        if kernel == broken:
            tensors = [each for each in arguments if isinstance(each, torch.Tensor)]
            tensors[OUTPUTS.get(kernel, -1)][-1] = torch.nan

    def there(backend: str, *_: Any) -> str | None:
        return None if backend == "cuda" else "torch is asked for"

    monkeypatch.setattr(cuda, "launch", launch)
    monkeypatch.setattr(sys.modules["opt3dgs_optim.lbfgs.two_loop"], "obstacle", there)
    if broken:
        (name,) = [name for name, kernels in KERNELS_OF.items() if broken in kernels]
        with pytest.raises(ArithmeticError, match=f"{name} differs from torch by nan in"):
            doctor.kernels_against_torch(torch.device("cpu"))
        return
    assert sorted(itertools.chain(*KERNELS_OF.values())) == sorted(COMPARED)
    said = doctor.kernels_against_torch(torch.device("cpu"))
    for name in doctor.KERNELS:
        assert len(re.findall(rf"{name} \d\.\de-\d\d", said)) == 2  # two precisions


def test_the_histogram_is_compared_with_the_hosts(monkeypatch: pytest.MonkeyPatch) -> None:
    here = torch.device("cpu")
    assert "mean multiplier of 400 energies differs by 0.0e+00" in doctor.histogram_kernel(here)
    doubles = []

    class Other(EnergyHistogram):
        @property
        def mean_multiplier(self) -> Tensor:
            doubles.append(self)
            return super().mean_multiplier + 0.01 * len(doubles)

    monkeypatch.setattr(doctor, "EnergyHistogram", Other)
    with pytest.raises(ArithmeticError, match=r"differs by 1\.0e-02 \(limit 1e-03\)"):
        doctor.histogram_kernel(here)


@pytest.mark.thorough
def test_doctor_as_a_command() -> None:
    call = [sys.executable, "-W", "error", "-m", "opt3dgs_optim", "doctor", "--device", "cpu"]
    done = subprocess.run(call, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    for text in (__version__, torch.__version__, "the kernels need a CUDA device"):
        assert text in done.stdout
    assert done.stdout.count("\n  ok ") == 1
    for check in ("CUDA kernels", "histogram on CUDA"):
        assert f"\n  --      {check}: not launched: the kernels need" in done.stdout


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
