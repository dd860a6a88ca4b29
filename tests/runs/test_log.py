"""The run log: what is written comes back, whatever happens to the process that writes."""

from __future__ import annotations

import gc
import json
import math
import os
import weakref
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from opt3dgs_optim.runs import RunLog, read_run
from opt3dgs_optim.runs import log as log_module

NUMBERS = st.one_of(
    st.floats(),
    st.integers(-(2**53), 2**53),
    st.integers(-(2**53), 2**53).map(np.int64),
    st.booleans(),
    st.booleans().map(torch.tensor),
    st.floats(width=32).map(torch.tensor),
    st.floats().map(lambda value: torch.tensor([value], dtype=torch.float64)),
)
SHARED_TMP = settings(
    deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def same(a, b):
    return a == b or (math.isnan(a) and math.isnan(b))


def strict_lines(path):
    def refuse(name):
        raise AssertionError(f"{name} is not strict JSON")

    return [json.loads(text, parse_constant=refuse) for text in path.read_text().splitlines()]


def write_sample(path):
    with RunLog(path, metadata={"arm": "stock", "seed": 0}) as log:
        for i in range(1, 5):
            log.step(i, energy=0.1 * i, nu=float("nan"))
        log.evaluation(4, psnr=20.5)
        log.evaluation(4, ssim=0.5)


@SHARED_TMP
@given(rows=st.lists(st.dictionaries(st.sampled_from(["energy", "nu", "loss"]), NUMBERS)))
def test_steps_round_trip_exactly(tmp_path, rows):
    path = tmp_path / "run.jsonl"
    path.unlink(missing_ok=True)
    with RunLog(path) as log:
        for i, row in enumerate(rows):
            log.step(i, **row)
    strict_lines(path)
    run = read_run(path)
    assert run.steps["iteration"].tolist() == list(range(len(rows)))
    for name in ("energy", "nu", "loss"):
        iterations, _, values = run.series(name, "step")
        expected = [(i, float(row[name])) for i, row in enumerate(rows) if name in row]
        assert iterations.tolist() == [i for i, _ in expected]
        assert all(same(a, b) for a, (_, b) in zip(values, expected, strict=True))


def test_first_line_describes_the_run(tmp_path):
    write_sample(tmp_path / "plush" / "run.jsonl")
    run = read_run(tmp_path / "plush" / "run.jsonl")
    assert run.name == "plush/run"
    assert run.metadata == {"arm": "stock", "seed": 0}
    assert f", {os.cpu_count()} CPUs" in run.origin["machine"]
    assert not torch.cuda.is_initialized()


def test_cut_at_every_byte_every_complete_line_comes_back_and_the_log_goes_on(tmp_path):
    whole, cut = tmp_path / "whole.jsonl", tmp_path / "cut.jsonl"
    write_sample(whole)
    data = whole.read_bytes()
    for offset in range(0, len(data) + 1, 5):
        cut.write_bytes(data[:offset])
        complete = data[:offset].count(b"\n")
        assert len(read_run(cut).records) == complete
        with RunLog(cut, resume=4) as log:
            log.step(9, energy=1.0)
        assert len(read_run(cut).records) == complete + 2  # a start and the step
        assert read_run(cut).steps["energy"][-1] == 1.0


@pytest.mark.parametrize(
    "line",
    [
        b"no json",
        b"[1]",
        b'{"kind":"other","iteration":1,"seconds":1}',
        b'{"kind":"step","iteration":1.5,"seconds":1}',
        b'{"kind":"step","iteration":1}',
        b'{"kind":"evaluation","iteration":1,"seconds":1,"psnr":"good"}',
        b"\xff\xfe",
        b"",
    ],
    ids=lambda line: line[:50].decode("ascii", "backslashreplace"),
)
def test_any_other_line_is_named(tmp_path, line):
    path = tmp_path / "run.jsonl"
    write_sample(path)
    lines = path.read_bytes().splitlines()
    path.write_bytes(b"\n".join([*lines[:2], line, *lines[2:]]) + b"\n")
    before = path.read_bytes()
    for call in (read_run, lambda path: RunLog(path, resume=2)):
        with pytest.raises(ValueError, match=r"run\.jsonl, line 3: ") as caught:
            call(path)
        assert "\n" not in str(caught.value)
    assert path.read_bytes() == before


def test_a_log_that_is_there_is_not_written_over(tmp_path):
    path = tmp_path / "run.jsonl"
    write_sample(path)
    before = path.read_bytes()
    with pytest.raises(FileExistsError, match=r"run\.jsonl' is there already; .*resume=ITERATION"):
        RunLog(path)
    assert path.read_bytes() == before
    with pytest.raises(FileNotFoundError):
        RunLog(tmp_path / "missing.jsonl", resume=1)
    assert not (tmp_path / "missing.jsonl").exists()


def test_a_trainers_configuration_may_be_metadata(tmp_path: Path) -> None:
    with RunLog(tmp_path / "run.jsonl", metadata={"data": Path("scenes/lego"), "seed": 1}) as log:
        log.step(0, loss=1.0)
    assert read_run(log.path).metadata == {"data": str(Path("scenes/lego")), "seed": 1}


def test_wrong_arguments_name_call_value_and_what_is_allowed(tmp_path):
    with pytest.raises(ValueError, match="JSON"):
        RunLog(tmp_path / "run.jsonl", metadata={"x": math.nan})
    assert not (tmp_path / "run.jsonl").exists()
    with RunLog(tmp_path / "a" / "run.jsonl") as log:
        for wrong in (-1, 1.5, "1"):
            with pytest.raises(ValueError, match=rf"RunLog\.step: iteration={wrong!r}, but an int"):
                log.step(wrong)  # pyright: ignore
        with pytest.raises(ValueError, match=r"RunLog\.step: energy=a tensor of shape \(2,\)"):
            log.step(1, energy=torch.zeros(2))
        for wrong in ("nan", None, 1j, np.str_("1")):
            with pytest.raises(ValueError, match=r"RunLog\.evaluation: psnr=.*one real number"):
                log.evaluation(1, psnr=wrong)  # type: ignore[arg-type]
        for call in (log.step, log.evaluation):
            for name in ("kind", "seconds"):
                with pytest.raises(ValueError, match=f"{name} is a name of the log's own"):
                    call(1, **{name: 1.0})  # pyright: ignore
    assert len(read_run(log.path).records) == 1
    with pytest.raises(ValueError, match="closed file"):
        log.step(1)
    log.close()


def test_resume_supersedes_and_continues_the_clock(tmp_path):
    now = [100.0]
    path = tmp_path / "run.jsonl"
    with RunLog(path, metadata={"arm": "a"}, clock=lambda: now[0]) as log:
        for i in range(1, 11):
            now[0] += 1
            log.step(i, energy=float(i))
        log.evaluation(10, psnr=1.0)
    now[0] += 1000
    with RunLog(path, resume=6, metadata={"machine": "b"}, clock=lambda: now[0]) as log:
        assert log.seconds == 6
        now[0] += 2
        log.step(7, energy=70.0)
    run = read_run(path)
    assert run.steps["iteration"].tolist() == [1, 2, 3, 4, 5, 6, 7]
    assert run.steps["energy"].tolist() == [1, 2, 3, 4, 5, 6, 70]
    assert run.steps["seconds"].tolist() == [1, 2, 3, 4, 5, 6, 8]
    assert len(run.evaluations["iteration"]) == 0
    assert run.metadata == {"arm": "a", "machine": "b"}
    with RunLog(path, resume=0, clock=lambda: now[0]) as log:
        assert log.seconds == 0
    assert len(read_run(path).steps["iteration"]) == 0


def test_pauses_stop_the_clock_also_nested_and_after_an_error(tmp_path):
    now = [0.0]
    with RunLog(tmp_path / "run.jsonl", clock=lambda: now[0]) as log:
        now[0] = 2
        with log.paused():
            now[0] = 10
            with log.paused():
                now[0] = 20
            assert log.seconds == 2
            log.evaluation(1, psnr=20.0)
        now[0] = 23
        assert log.seconds == 5
        pause = log.paused()
        pause.__enter__()
        now[0] = 50
        assert not pause.__exit__(RuntimeError, RuntimeError(), None)
        now[0] = 51
        assert log.seconds == 6
    assert read_run(tmp_path / "run.jsonl").evaluations["seconds"].tolist() == [2]


def test_no_autograd_graph_is_kept(tmp_path):
    with RunLog(tmp_path / "run.jsonl") as log:
        loss = torch.ones(3, requires_grad=True).sum()
        alive = weakref.ref(loss)
        log.step(1, loss=loss)
        log.evaluation(1, loss=loss)
        del loss
        gc.collect()
        assert alive() is None


class FakeReading:
    """Numbers on their way from a GPU: they come when told to, or when waited for."""

    def __init__(self, value: float, count: int):
        self.done, self.numbers = False, [value] * count

    def take(self, wait: bool):
        self.done |= wait
        return self.numbers if self.done else None


@pytest.fixture
def gpu(monkeypatch):
    """On a machine without CUDA: every tensor plays the part of a CUDA one."""
    readings = []

    def reading_of(values):
        readings.append(FakeReading(float(len(readings) + 1), len(values)))
        return readings[-1]

    monkeypatch.setattr(log_module, "_reading_of", reading_of)
    monkeypatch.setattr(log_module, "_on_gpu", lambda value: isinstance(value, torch.Tensor))
    return readings


def test_lines_wait_for_the_gpu_in_order_without_waiting_for_it(tmp_path, gpu):
    path, scalar = tmp_path / "run.jsonl", torch.tensor(0.0)
    with RunLog(path) as log:
        log.step(1, energy=scalar)
        log.step(2, energy=scalar, nu=2.0)
        log.step(3, energy=3.0)
        assert len(strict_lines(path)) == 1
        gpu[1].done = True  # not the first: order is kept
        log.step(4, energy=scalar)
        assert len(strict_lines(path)) == 1
        gpu[0].done = True
        log.step(5, energy=scalar)
        assert len(strict_lines(path)) == 4
        log.evaluation(5, psnr=20.0)
        assert len(strict_lines(path)) == 7
        log.step(6, energy=scalar)
    assert read_run(path).steps["energy"].tolist() == [1, 2, 3, 3, 4, 5]
    assert read_run(path).steps["iteration"].tolist() == [1, 2, 3, 4, 5, 6]


@pytest.mark.cuda
@pytest.mark.filterwarnings("ignore:Synchronization debug mode is a prototype:UserWarning")
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_cuda_steps_do_not_synchronize(tmp_path):
    with RunLog(tmp_path / "run.jsonl") as log:
        energy = torch.zeros((), device="cuda", requires_grad=True)
        count = torch.zeros((), device="cuda", dtype=torch.int64)
        log.step(0, energy=energy, count=count)  # first pinned allocation
        torch.cuda.set_sync_debug_mode("error")
        try:
            for i in range(1, 100):
                count += 1
                log.step(i, energy=energy, count=count, nu=1.0)
        finally:
            torch.cuda.set_sync_debug_mode("default")
        log.evaluation(99, psnr=energy)
    run = read_run(tmp_path / "run.jsonl")
    assert run.steps["count"].tolist() == list(range(100))


def test_a_log_names_the_gpu_and_a_pause_waits_for_it(tmp_path, monkeypatch):
    waited = []
    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "a GPU")
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: waited.append(True))
    with RunLog(tmp_path / "log.jsonl") as log:
        log.step(0, loss=0.5)
        with log.paused():
            log.evaluation(1, psnr=20.0)
    assert ', a GPU"' in (tmp_path / "log.jsonl").read_text()
    assert waited == [True, True]  # before the pause and after it
