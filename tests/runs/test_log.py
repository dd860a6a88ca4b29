"""The run log: what is written comes back, whatever happens to the process that writes."""

from __future__ import annotations

import gc
import inspect
import json
import math
import os
import signal
import subprocess
import sys
import time
import weakref
from enum import Enum
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from opt3dgs_optim.runs import RunLog, lines, read_run
from opt3dgs_optim.runs import log as log_module

NUMBERS = st.one_of(
    st.floats(allow_nan=True, allow_infinity=True), st.integers(-(2**53), 2**53), st.booleans()
)
TEXTS = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"))
SHARED_TMP = settings(
    deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def same(a, b):
    return a == b or (math.isnan(a) and math.isnan(b))


def strict_lines(path):
    def refuse(name):
        raise AssertionError(f"{name} is not strict JSON")

    return [json.loads(text, parse_constant=refuse) for text in path.read_text().splitlines()]


def write_sample(path):
    with RunLog(path, metadata={"arm": "mcmc", "seed": 0}) as log:
        for i in range(1, 5):
            log.step(i, phase="exploration", energy=0.1 * i, nu=float("nan"))
        log.evaluation(4, psnr=20.5)
        log.event("finished", 4, note="a\nb é")


@SHARED_TMP
@given(rows=st.lists(st.dictionaries(st.sampled_from(["energy", "nu", "loss"]), NUMBERS)))
def test_steps_round_trip_exactly(tmp_path, rows):
    path = tmp_path / "run.jsonl"
    path.unlink(missing_ok=True)
    with RunLog(path) as log:
        for i, row in enumerate(rows):
            log.step(i, phase="exploration", **row)
    strict_lines(path)
    run = read_run(path)
    assert run.steps["iteration"].tolist() == list(range(len(rows)))
    for name in ("energy", "nu", "loss"):
        iterations, _, values = run.series(name, "step")
        expected = [(i, float(row[name])) for i, row in enumerate(rows) if name in row]
        assert iterations.tolist() == [i for i, _ in expected]
        assert all(same(a, b) for a, (_, b) in zip(values, expected, strict=True))


@SHARED_TMP
@given(
    value=st.floats(width=32, allow_nan=True, allow_infinity=True), dtype=st.sampled_from([32, 64])
)
def test_tensors_round_trip_exactly(tmp_path, value, dtype):
    path = tmp_path / "run.jsonl"
    path.unlink(missing_ok=True)
    with RunLog(path) as log:
        tensor = torch.tensor(value, dtype=getattr(torch, f"float{dtype}"), requires_grad=True)
        log.step(0, phase="exploration", energy=tensor)
        log.evaluation(0, psnr=tensor[None], flag=torch.tensor(True), points=np.int64(7))  # type: ignore[arg-type]
    run = read_run(path)
    assert same(run.steps["energy"][0], value)
    assert same(run.evaluations["psnr"][0], value)
    assert run.evaluations["flag"][0] == 1
    assert run.evaluations["points"][0] == 7


@SHARED_TMP
@given(
    info=st.recursive(
        st.none() | st.booleans() | st.integers() | TEXTS | st.floats(allow_nan=False),
        lambda inner: st.lists(inner) | st.dictionaries(TEXTS, inner),
        max_leaves=8,
    )
)
def test_metadata_and_events_round_trip(tmp_path, info):
    path = tmp_path / "run.jsonl"
    path.unlink(missing_ok=True)
    with RunLog(path, metadata={"info": info}) as log:
        log.event("switch", 3, info=info)
    run = read_run(path)
    assert run.metadata["info"] == info
    assert run.events[0]["info"] == info
    assert run.events[0]["event"] == "switch"


def test_texts_come_back_as_they_are_and_numbers_may_be_anything(tmp_path):
    path = tmp_path / "run.jsonl"
    with RunLog(path, metadata={"arm": "a\0", "\ud800": [Path("b\udcff")], "x": math.nan}) as log:
        log.step(1, phase="\udfff")
        log.event("\0", 1, error="c\0d", loss=-math.inf)
        with pytest.raises(ValueError, match=r"RunLog\.step\('a\\x00'=.*printable"):
            log.step(1, phase=None, **{"a\0": 1.0})
        with pytest.raises(ValueError, match=r"iteration=1\d*, but an integer in 0\.\."):
            log.step(10**17)
    strict_lines(path)
    run = read_run(path)
    assert run.metadata == {"arm": "a\0", "\ud800": ["b\udcff"], "x": "nan"}
    assert run.steps["phase"].tolist() == ["\udfff"]
    assert (run.events[0]["event"], run.events[0]["loss"]) == ("\0", "-inf")


def test_columns_begin_and_end_at_any_step_and_a_phase_need_not_be_told(tmp_path):
    class Phase(Enum):
        LAST = "exploitation"

    with RunLog(tmp_path / "run.jsonl") as log:
        log.step(1, loss=0.5)
        log.step(2, loss=0.25, faded=torch.tensor(0.125))
        log.step(3, phase=Phase.LAST, faded=0.5)
    steps = read_run(tmp_path / "run.jsonl").steps
    np.testing.assert_array_equal(steps["loss"], [0.5, 0.25, np.nan])
    np.testing.assert_array_equal(steps["faded"], [np.nan, 0.125, 0.5])
    assert steps["phase"].tolist() == ["", "", "exploitation"]


def test_first_line_describes_the_run_without_host_or_folders(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["/home/me/train.py", "--data=/data/plush/", "--arm", "mcmc"])
    write_sample(tmp_path / "run.jsonl")
    run = read_run(tmp_path / "run.jsonl")
    assert run.name == "run"
    assert run.metadata == {"arm": "mcmc", "seed": 0}
    assert run.origin["command"] == "train.py --data=plush --arm mcmc"
    assert f", {os.cpu_count()} CPUs" in run.origin["machine"]
    assert "phase" in run.steps
    assert not torch.cuda.is_initialized()


def test_cut_at_every_byte_every_complete_line_comes_back_and_the_log_goes_on(tmp_path):
    whole, cut = tmp_path / "whole.jsonl", tmp_path / "cut.jsonl"
    write_sample(whole)
    data = whole.read_bytes()
    for offset in range(len(data) + 1):
        cut.write_bytes(data[:offset])
        complete = data[:offset].count(b"\n")
        assert len(read_run(cut).records) == complete
        with RunLog(cut) as log:
            log.step(9, phase="exploitation", energy=1.0)
        # The start and the step; a line that lacked only its newline counts as well now.
        only_newline = offset < len(data) and data[offset : offset + 1] == b"\n"
        assert len(read_run(cut).records) == complete + 2 + only_newline
        assert read_run(cut).steps["energy"][-1] == 1.0


def test_torn_twice(tmp_path):
    path = tmp_path / "run.jsonl"
    write_sample(path)
    path.write_bytes(path.read_bytes()[:-5] + b'\n{"kind":"sta')
    assert len(read_run(path).records) == 6
    with RunLog(path) as log:
        log.event("finished", 4)
    assert len(read_run(path).records) == 8


@pytest.mark.parametrize(
    "line",
    [
        b"no json",
        b"[1]",
        b'{"kind":"other","iteration":1,"seconds":1}',
        b'{"kind":"step","iteration":1.5,"seconds":1}',
        b'{"kind":"step","iteration":1}',
        b'{"kind":"evaluation","iteration":1,"seconds":1,"psnr":"good"}',
        b'{"kind":"event","iteration":1,"seconds":1}',
        b'{"kind":"start","iteration":1,"seconds":1,"metadata":3}',
        b"\xff\xfe",
        b"",
        b'{"kind":"step","iteration":1,"seconds":1,"nu":%s}' % (b"9" * 400),
        b'{"kind":"step","iteration":1,"seconds":1,"nu":%s}' % (b"9" * 5000),
        b'{"kind":"step","iteration":%s,"seconds":1}' % (b"9" * 400),
        b'{"kind":"step","iteration":-1,"seconds":1}',
        b'{"kind":"step","iteration":1,"seconds":1e400}',
        b'{"kind":"step","iteration":1,"seconds":"nan"}',
        b'{"kind":"start","iteration":1,"seconds":1,"metadata":%s1%s}'
        % (b'{"a":' * 1000, b"}" * 1000),
        b"[" * 100_000,
        b'{"kind":"step","iter\0ation":1,"seconds":1}',
    ],
    ids=lambda line: line[:50].decode("ascii", "backslashreplace"),
)
def test_any_other_malformed_line_is_named(tmp_path, line):
    path = tmp_path / "run.jsonl"
    write_sample(path)
    lines = path.read_bytes().splitlines()
    path.write_bytes(b"\n".join([*lines[:2], line, *lines[2:]]) + b"\n")
    with pytest.raises(ValueError, match=r"run\.jsonl, line 3: ") as caught:
        read_run(path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < len(str(path)) + 300
    before = path.read_bytes()
    with pytest.raises(ValueError, match="line 3"):
        RunLog(path)
    assert path.read_bytes() == before


def test_kill_loses_at_most_the_last_line(tmp_path):
    path = tmp_path / "run.jsonl"
    code = (
        "import sys\nfrom opt3dgs_optim.runs import RunLog\nlog = RunLog(sys.argv[1])\n"
        "for i in range(10**9):\n"
        "    log.step(i, phase='exploration', energy=0.1)\n"
        "    sys.stdout.write(f'{i}\\n'); sys.stdout.flush()\n"
    )
    with subprocess.Popen([sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        seen = [int(child.stdout.readline()) for _ in range(200)]
        child.send_signal(signal.SIGKILL)
        seen += [int(text) for text in child.stdout.read().split(b"\n")[:-1]]
    iterations = read_run(path).steps["iteration"].tolist()
    assert iterations[: len(seen)] == seen
    assert len(iterations) <= len(seen) + 1
    RunLog(path).close()  # and the lock went with the process


def test_resume_supersedes_and_continues_the_clock(tmp_path, monkeypatch):
    now = [100.0]
    monkeypatch.setattr("time.perf_counter", lambda: now[0])
    path = tmp_path / "run.jsonl"
    with RunLog(path, metadata={"arm": "a"}) as log:
        for i in range(1, 11):
            now[0] += 1
            log.step(i, phase="exploration", energy=float(i))
        log.evaluation(10, psnr=1.0)
    now[0] += 1000
    with RunLog.resume(path, iteration=6, metadata={"machine": "b"}) as log:
        assert log.seconds == 6
        now[0] += 2
        log.step(7, phase="exploration", energy=70.0)
    run = read_run(path)
    assert run.steps["iteration"].tolist() == [1, 2, 3, 4, 5, 6, 7]
    assert run.steps["energy"].tolist() == [1, 2, 3, 4, 5, 6, 70]
    assert run.steps["seconds"].tolist() == [1, 2, 3, 4, 5, 6, 8]
    assert len(run.evaluations["iteration"]) == 0
    assert [event["event"] for event in run.events] == ["resumed"]
    assert run.metadata == {"arm": "a", "machine": "b"}
    with RunLog.resume(path, iteration=0) as log:
        assert log.seconds == 0
        with pytest.raises(ValueError, match="kind='resumed' is the log's own"):
            log.event("resumed", 0)
    assert len(read_run(path).steps["iteration"]) == 0


def test_plain_reopening_appends_and_continues_the_clock(tmp_path, monkeypatch):
    monkeypatch.setattr("time.perf_counter", lambda: 0.0)
    path = tmp_path / "run.jsonl"
    path.write_text('{"kind":"step","iteration":3,"seconds":7.5,"energy":1}\n')
    with RunLog(path) as log:
        assert log.seconds == 7.5
        log.step(4, phase="exploration")
    assert read_run(path).steps["seconds"].tolist() == [7.5, 7.5]
    with pytest.raises(FileNotFoundError, match=r"RunLog\.resume.*missing"):
        RunLog.resume(tmp_path / "missing.jsonl", iteration=1)


def test_pauses_stop_the_clock_also_nested_and_after_an_error(tmp_path, monkeypatch):
    now = [0.0]
    monkeypatch.setattr("time.perf_counter", lambda: now[0])
    with RunLog(tmp_path / "run.jsonl") as log:
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


class Witness:
    """Something that an autograd graph keeps alive."""


class Doubled(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x, witness):  # type: ignore[override]
        ctx.witness = witness
        return x * 2

    @staticmethod
    def backward(ctx, grad):  # type: ignore[override]
        return grad * 2, None


def test_no_autograd_graph_is_kept(tmp_path):
    with RunLog(tmp_path / "run.jsonl") as log:
        witness = Witness()
        alive = weakref.ref(witness)
        loss = Doubled.apply(torch.ones(3, requires_grad=True), witness).sum()  # type: ignore
        del witness
        assert alive() is not None
        log.step(1, phase="exploration", loss=loss)
        log.evaluation(1, loss=loss)
        del loss
        gc.collect()
        assert alive() is None


@pytest.mark.skipif(sys.platform == "win32", reason="no fcntl on this system, so no lock")
def test_a_second_writer_is_refused(tmp_path):
    path = tmp_path / "run.jsonl"
    with RunLog(path):
        with pytest.raises(BlockingIOError, match="another RunLog is writing"):
            RunLog(path)
        code = f"from opt3dgs_optim.runs import RunLog; RunLog({str(path)!r})"
        result = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
        assert b"another RunLog is writing this file" in result.stderr
        read_run(path)
    RunLog(path).close()


class FakeEvent:
    """Stands for a torch.cuda.Event: completes when told to, or when waited for."""

    def __init__(self):
        self.done = False

    def query(self):
        return self.done

    def synchronize(self):
        self.done = True


@pytest.fixture
def gpu(monkeypatch):
    """On a machine without CUDA: every tensor plays the part of a CUDA one."""
    events = []

    def to_pinned(values):
        events.append(FakeEvent())
        return torch.full((len(values),), float(len(events)), dtype=torch.float64), events[-1]

    monkeypatch.setattr(log_module, "_to_pinned", to_pinned)
    monkeypatch.setattr(log_module, "_on_gpu", lambda value: isinstance(value, torch.Tensor))
    return events


def test_lines_wait_for_the_gpu_in_order_without_waiting_for_it(tmp_path, gpu):
    path, scalar = tmp_path / "run.jsonl", torch.tensor(0.0)
    with RunLog(path) as log:
        log.step(1, phase="exploration", energy=scalar)
        log.step(2, phase="exploration", energy=scalar, nu=2.0)
        log.step(3, phase="exploration", energy=3.0)
        assert len(strict_lines(path)) == 1
        gpu[1].done = True  # not the first: order is kept
        log.step(4, phase="exploration", energy=scalar)
        assert len(strict_lines(path)) == 1
        gpu[0].done = True
        log.step(5, phase="exploration", energy=scalar)
        assert len(strict_lines(path)) == 4
        log.event("waited", 5)
        assert len(strict_lines(path)) == 7
        log.step(6, phase="exploration", energy=scalar)
    assert read_run(path).steps["energy"].tolist() == [1, 2, 3, 3, 4, 5]
    assert read_run(path).steps["iteration"].tolist() == [1, 2, 3, 4, 5, 6]


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_cuda_steps_do_not_synchronize(tmp_path):
    with RunLog(tmp_path / "run.jsonl") as log:
        energy = torch.zeros((), device="cuda", requires_grad=True)
        count = torch.zeros((), device="cuda", dtype=torch.int64)
        log.step(0, phase="exploration", energy=energy, count=count)  # first pinned allocation
        torch.cuda.set_sync_debug_mode("error")
        try:
            for i in range(1, 100):
                count += 1
                log.step(i, phase="exploration", energy=energy, count=count, nu=1.0)
        finally:
            torch.cuda.set_sync_debug_mode("default")
        log.evaluation(99, psnr=energy)
    run = read_run(tmp_path / "run.jsonl")
    assert run.steps["count"].tolist() == list(range(100))


def test_wrong_arguments_name_call_value_and_what_is_allowed(tmp_path):
    with pytest.raises(TypeError, match=r"object.*must be a number"):
        RunLog(tmp_path / "run.jsonl", metadata={"x": object()})
    assert not (tmp_path / "run.jsonl").exists()
    with RunLog(tmp_path / "a" / "run.jsonl") as log:
        with pytest.raises(ValueError, match=r"RunLog\.step: iteration=-1, but an integer"):
            log.step(-1, phase="exploration")
        with pytest.raises(TypeError, match="cannot be interpreted as an integer"):
            log.evaluation(1.5)  # type: ignore[arg-type]
        with pytest.raises(ValueError, match=r"energy=tensor of \(2,\)"):
            log.step(1, phase="exploration", energy=torch.zeros(2))
        with pytest.raises(TypeError, match="psnr='nan'"):
            log.evaluation(1, psnr="nan")  # type: ignore[arg-type]
        with pytest.raises(ValueError, match="reserved"):
            log.evaluation(1, seconds=3.0)
        with pytest.raises(ValueError, match="reserved"):
            log.event("switch", 1, seconds=3.0)
    assert len(read_run(log.path).records) == 1
    with pytest.raises(ValueError, match="is closed"):
        log.step(1, phase="exploration")
    log.close()


def test_real_clock_runs(tmp_path):
    with RunLog(tmp_path / "run.jsonl") as log:
        time.sleep(0.02)
        assert 0.02 <= log.seconds < 20


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"metadata": {"a": object()}}, TypeError),
        ({"path": None}, TypeError),
        ({"clock": 3}, TypeError),
    ],
    ids=["metadata", "path", "clock"],
)
def test_a_wrong_option_is_refused(options, error, tmp_path):
    with pytest.raises(error):
        RunLog(**{"path": tmp_path / "run.jsonl", **options})
    assert set(inspect.signature(RunLog).parameters) == {"path", "metadata", "clock"}


def test_a_log_on_a_system_without_locks(tmp_path, monkeypatch):
    def refuse(file, how):
        raise OSError("no locks here")

    monkeypatch.setattr("fcntl.flock", refuse)
    for _ in "ab":
        with RunLog(tmp_path / "log.jsonl") as log:
            log.step(0, phase="exploration", loss=0.5)
    monkeypatch.setattr(lines, "fcntl", None)  # as on Windows
    with RunLog(tmp_path / "log.jsonl") as log:
        log.step(1, phase="exploration", loss=0.25)
    kinds = [line["kind"] for line in strict_lines(tmp_path / "log.jsonl")]
    assert kinds.count("start") == 3


def test_a_log_names_the_gpu_and_a_pause_waits_for_it(tmp_path, monkeypatch):
    waited = []
    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "a GPU")
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: waited.append(True))
    with RunLog(tmp_path / "log.jsonl") as log:
        log.step(0, phase="exploration", loss=0.5)
        with log.paused():
            log.evaluation(1, psnr=20.0)
    assert ", a GPU, " in (tmp_path / "log.jsonl").read_text()
    assert waited == [True, True]  # before the pause and after it


NUMPYS = [np.float16, np.float32, np.float64, np.longdouble, np.int8, np.int64, np.uint64, np.bool_]


@pytest.mark.parametrize("kind", NUMPYS, ids=lambda kind: kind.__name__)
def test_numbers_of_numpy_are_numbers_everywhere(tmp_path, kind):
    path = tmp_path / "run.jsonl"
    one, about = kind(1), {"seed": kind(1), "each": {"list": [kind(1)], "key": {kind(1): kind(1)}}}
    with RunLog(path, metadata=about) as log:
        log.step(np.int64(3), loss=one, array=np.array(one), single=np.array([one]))
        log.evaluation(np.int32(4), psnr=one)
        log.event("pruned", np.uint8(5), points=one, about=about)
    strict_lines(path)
    run = read_run(path)
    assert run.steps["iteration"].tolist() == [3]
    assert [run.steps[name][0] for name in ("loss", "array", "single")] == [1.0] * 3
    assert run.evaluations["psnr"].tolist() == [1.0]
    assert run.metadata["seed"] == run.events[0]["points"] == 1
    assert run.events[0]["about"] == run.metadata
    assert run.metadata["each"]["list"] == list(run.metadata["each"]["key"].values()) == [1]


@pytest.mark.parametrize(
    ("value", "error"),
    [
        (np.complex64(1), TypeError),
        (np.datetime64("2026-11-25"), TypeError),
        (np.str_("1"), TypeError),
        (np.array([1.0, 2.0]), ValueError),
        (np.array([]), ValueError),
        (10**400, ValueError),
        (-(10**400), ValueError),
        (None, TypeError),
    ],
)
def test_what_no_reader_could_take_as_a_number_is_refused(tmp_path, value, error):
    with RunLog(tmp_path / "run.jsonl") as log:
        for write in (log.step, log.evaluation):
            with pytest.raises(error, match=r"RunLog\.(step|evaluation)\(value="):
                write(1, value=value)
    assert len(read_run(log.path).records) == 1


# -- mirrors ---------------------------------------------------------------------------------------


class Board:
    """Stands for a SummaryWriter."""

    def __init__(self):
        self.seen = []

    def add_scalar(self, tag, value, step):
        self.seen.append((tag, value, step))


class Wandb:
    """Stands for a run of Weights & Biases."""

    def __init__(self):
        self.seen = []

    def log(self, values, step):
        self.seen.append((values, step))


def test_a_mirror_gets_the_numbers_of_steps_and_evaluations(tmp_path, monkeypatch):
    monkeypatch.setattr("time.perf_counter", lambda: 0.0)
    board, wandb = Board(), Wandb()
    with RunLog(tmp_path / "run.jsonl") as log:
        log.step(0, loss=7.0)  # before there is a mirror
        log.mirror(board)
        log.mirror(wandb)
        log.step(2, phase="exploration", loss=torch.tensor(0.5), nu=math.inf)
        log.event("switch", 2, reason=3.0)
        log.evaluation(3, psnr=20.0)
    assert board.seen == [
        ("step/loss", 0.5, 2),
        ("step/nu", math.inf, 2),
        ("step/seconds", 0.0, 2),
        ("evaluation/psnr", 20.0, 3),
        ("evaluation/seconds", 0.0, 3),
    ]
    assert wandb.seen == [
        ({"step/loss": 0.5, "step/nu": math.inf, "step/seconds": 0.0}, 2),
        ({"evaluation/psnr": 20.0, "evaluation/seconds": 0.0}, 3),
    ]
    assert all(type(value) is float for _, value, _ in board.seen)


def test_a_mirror_does_not_wait_for_the_gpu(tmp_path, gpu):
    board, scalar = Board(), torch.tensor(0.0)
    with RunLog(tmp_path / "run.jsonl") as log:
        log.mirror(board)
        log.step(1, loss=scalar)
        log.step(2, loss=scalar)
        assert board.seen == []
        assert not any(event.done for event in gpu)
        gpu[0].done = True
        log.step(3, loss=scalar)
        assert [(tag, step) for tag, _, step in board.seen] == [
            ("step/loss", 1),
            ("step/seconds", 1),
        ]
        assert not gpu[1].done
    assert [step for tag, _, step in board.seen if tag == "step/loss"] == [1, 2, 3]


def test_a_mirror_that_fails_is_named_once_and_stops_nothing(tmp_path, caplog):
    class Broken:
        calls = 0

        def log(self, values, step):
            self.calls += 1
            raise OSError("no net")

    broken, board = Broken(), Board()
    with RunLog(tmp_path / "run.jsonl") as log, caplog.at_level("WARNING", "opt3dgs_optim"):
        log.mirror(broken)
        log.mirror(board)
        for i in range(3):
            log.step(i, loss=0.5)
    assert broken.calls == 1
    assert len(caplog.records) == 1
    assert "no net" in caplog.text
    assert [step for tag, _, step in board.seen if tag == "step/loss"] == [0, 1, 2]
    assert read_run(tmp_path / "run.jsonl").steps["loss"].tolist() == [0.5] * 3


def test_what_is_no_writer_is_refused(tmp_path):
    with (
        RunLog(tmp_path / "run.jsonl") as log,
        pytest.raises(TypeError, match=r"mirror\(3\).*add_scalar"),
    ):
        log.mirror(3)


@pytest.mark.filterwarnings("default")  # what tensorboard warns of is not ours
def test_tensorboard_reads_back_what_was_mirrored(tmp_path):
    name = "tensorboard.backend.event_processing.event_accumulator"
    events = pytest.importorskip(name, reason="tensorboard is not installed")
    from torch.utils.tensorboard import SummaryWriter

    with SummaryWriter(str(tmp_path / "board")) as writer, RunLog(tmp_path / "run.jsonl") as log:
        log.mirror(writer)
        for i in range(1, 4):
            log.step(i, phase="exploration", loss=torch.tensor(1 / i), nu=math.nan)
        log.evaluation(3, psnr=20.5)
    found = events.EventAccumulator(str(tmp_path / "board"))
    found.Reload()
    losses = [(event.step, event.value) for event in found.Scalars("step/loss")]
    assert losses == [(i, pytest.approx(1 / i)) for i in (1, 2, 3)]
    assert [event.value for event in found.Scalars("evaluation/psnr")] == [20.5]
    assert math.isnan(found.Scalars("step/nu")[0].value)


def test_the_clock_may_be_another(tmp_path: Path) -> None:
    """That of the process, say; resumed, it goes on from the last line."""
    now = iter([10.0, 11.0, 13.5, 99.0, 100.0, 101.0, *[102.0] * 20])
    path = tmp_path / "log.jsonl"
    with RunLog(path, clock=lambda: next(now)) as log:
        log.step(1, loss=0.5)
    with RunLog.resume(path, iteration=1, clock=lambda: next(now)) as log:
        log.step(2, loss=0.5)
    seconds = [record["seconds"] for record in read_run(path).records]
    assert seconds[0] == 1.0
    assert seconds[1] == 3.5
    assert seconds == sorted(seconds)
    assert seconds[-1] < 10  # the time between the two sessions does not count


@pytest.mark.parametrize("call", ["step", "evaluation", "event"])
def test_no_line_may_have_metadata_of_its_own(call: str, tmp_path: Path) -> None:
    """A reader would take it for the run's."""
    with RunLog(tmp_path / "a.jsonl") as log:
        log.step(0, loss=1.0)
        line = ("pruned", 1) if call == "event" else (1,)
        with pytest.raises(ValueError, match="reserved"):
            getattr(log, call)(*line, metadata=1.0)
        log.step(1, loss=0.5)
    assert read_run(tmp_path / "a.jsonl").steps["loss"].tolist() == [1.0, 0.5]


def test_a_second_run_in_the_file_of_the_first_is_said_once(tmp_path: Path) -> None:
    for session in range(2):
        with RunLog(tmp_path / "a.jsonl") as log:
            if session:
                with pytest.warns(UserWarning, match=r"iteration 0 in a log that has 2 already"):
                    log.step(0)
            for iteration in range(session, 3):
                log.step(iteration)
    with RunLog.resume(tmp_path / "a.jsonl", iteration=1) as log:
        log.step(1)


def test_a_clock_that_is_set_back_leaves_a_log_that_can_be_read(tmp_path: Path) -> None:
    times = iter([10.0, 10.0, 9.0, 8.5, 12.0, 12.5])
    with RunLog(tmp_path / "run.jsonl", clock=lambda: next(times)) as log:
        for i in range(4):
            log.step(i, loss=1.0)
    seconds = [
        r["seconds"] for r in read_run(tmp_path / "run.jsonl").records if r["kind"] == "step"
    ]
    assert seconds == sorted(seconds)
    assert seconds[0] == 0.0


@pytest.mark.parametrize("iteration", [-1, 2.0, "2", None])
def test_a_resume_that_is_refused_has_not_opened_the_log(tmp_path: Path, iteration: int) -> None:
    path = tmp_path / "run.jsonl"
    with RunLog(path) as log:
        log.step(1, loss=1.0)
    before = path.read_text()
    with pytest.raises(ValueError, match="iteration=") as held:
        RunLog.resume(path, iteration=iteration)
    assert path.read_text() == before
    RunLog.resume(path, iteration=1).close()  # while the error's traceback is held
    assert held.value is not None


class Full:
    """A file on a disk that has room for so many bytes more."""

    def __init__(self, file, room):
        self._file, self.room = file, room

    def __getattr__(self, name):
        return getattr(self._file, name)

    def write(self, data):
        written = self._file.write(data[: self.room])
        self.room -= written
        if not written:
            raise OSError(28, "No space left on device")
        return written


@pytest.mark.parametrize("room", [0, 1, 15])
def test_a_line_for_which_there_is_no_room_is_not_begun(tmp_path, room):
    """The error names the file; what is written when there is room again is read."""
    path = tmp_path / "run.jsonl"
    with RunLog(path) as log:
        log.step(0, loss=1.0)
        log._file._file = full = Full(log._file._file, room)  # type: ignore[assignment]
        with pytest.raises(
            OSError, match=r"RunLog: a line cannot be written: No space.*run\.jsonl"
        ):
            log.step(1, loss=2.0)
        full.room = 10_000
        log.step(2, loss=3.0)
    assert read_run(path).steps["iteration"].tolist()[0] == 0
    assert read_run(path).steps["iteration"].tolist()[-1] == 2
    with RunLog.resume(path, iteration=2) as log:
        log.step(3, loss=4.0)
    assert read_run(path).steps["iteration"].tolist()[-1] == 3


@pytest.mark.parametrize("content", ['{"psnr": 27.1}', "x", '{"kind":"step","iter'])
def test_a_file_of_one_line_without_an_end_is_no_log(tmp_path, content):
    path = tmp_path / "results.json"
    path.write_text(content)
    for call in (RunLog, read_run):
        with pytest.raises(ValueError, match="line 1: no line of a run log"):
            call(path)
    assert path.read_text() == content
    path.write_text('{"kind":"sta')  # killed in its first line
    RunLog(path).close()
    assert len(read_run(path).metadata) == 0
