"""The live view, from a run that does not exist yet to the last page."""

from __future__ import annotations

import base64
import builtins
import html.parser
import importlib.util
import io
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from opt3dgs_optim import report
from opt3dgs_optim.follow import NO_MATPLOTLIB, NOTHING_YET, Follower, follow
from opt3dgs_optim.follow_page import duration, page
from opt3dgs_optim.follow_plot import legend_columns, log_scale
from opt3dgs_optim.follow_state import Watched, stamp_of, watch
from opt3dgs_optim.runlog import RunLog, read_run

needs_matplotlib = pytest.mark.skipif(
    importlib.util.find_spec("matplotlib") is None, reason="matplotlib is not installed"
)


def log_steps(log: RunLog, start: int, end: int, *, switch: int = 60) -> None:
    """Steps and an evaluation, as a trainer logs them."""
    for i in range(start, end):
        exploring = i < switch
        values = {"nu": 1 + 0.1 * (i % 3)} if exploring else {"accepted": 0.5}
        phase = "exploration" if exploring else "exploitation"
        log.step(i, phase=phase, loss=1 / (1 + i), **values)
    log.evaluation(end - 1, psnr=20 + 0.01 * end)


def write(path: Path, end: int, *events: str, **metadata: Any) -> Path:
    with RunLog(path, metadata={"arm": "mcmc", "iterations": 100, **metadata}) as log:
        log_steps(log, 0, end)
        for event in events:
            log.event(event, end - 1)
    return path


def state_of(path: Path, patience: float = 1e9) -> Watched:
    return watch(path, stamp_of(path), patience)


class Page(html.parser.HTMLParser):
    """What a page refers to, and its elements."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.text, self.urls, self.tags = text, [], []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        for name, value in attrs:
            if name in ("src", "srcset", "href", "action", "data", "poster", "background"):
                self.urls.append(value or "")

    @property
    def reloads(self) -> bool:
        return "location.reload()" in self.text or 'http-equiv="refresh"' in self.text


def live(out: Path) -> Page:
    return Page((out / "live.html").read_text(encoding="utf-8"))


# -- states ------------------------------------------------------------------------------------


def test_states_of_a_run_from_before_its_start_to_its_end(tmp_path: Path) -> None:
    path = tmp_path / "run" / "log.jsonl"
    assert state_of(path).state == "waiting"
    assert not state_of(path).over
    write(path, 40)
    running = state_of(path)
    assert (running.state, running.iteration, running.total) == ("running", 39, 100)
    assert running.label == "mcmc"
    assert running.phase == "exploration"
    assert running.evaluated("psnr") == pytest.approx(20.4)
    assert running.present("nu") == pytest.approx(1 + 0.1 * sum(i % 3 for i in range(40)) / 40)
    assert running.present("accepted") is None
    with RunLog.resume(path, iteration=30) as log:
        log_steps(log, 31, 100)
        log.event("interrupted", 99)
    assert state_of(path).state == "interrupted"
    with RunLog(path) as log:  # somebody starts it again
        assert state_of(path).state == "running"
        log.event("finished", 99)
    done = state_of(path)
    assert (done.state, done.over, done.phase) == ("finished", True, "exploitation")
    assert done.present("accepted") == 0.5


def test_a_resume_from_before_the_end_is_running_again(tmp_path: Path) -> None:
    path = write(tmp_path / "log.jsonl", 100, "finished")
    RunLog.resume(path, iteration=50).close()
    again = state_of(path)
    assert (again.state, again.iteration) == ("running", 50)


def test_silence_ends_a_run_that_never_says_finished(tmp_path: Path) -> None:
    path = write(tmp_path / "log.jsonl", 10)
    os.utime(path, (time.time() - 100, time.time() - 100))
    assert state_of(path, 200).state == "running"
    silent = state_of(path, 50)
    assert (silent.state, silent.over) == ("silent", True)
    assert silent.quiet == pytest.approx(100, abs=20)


def test_rate_and_labels(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    start = {"kind": "start", "iteration": 0, "seconds": 0.0}
    # Ten iterations a second; the last fifth is twice as slow.
    steps = [(i, 0.1 * i if i <= 80 else 8 + 0.2 * (i - 80)) for i in range(101)]
    lines = [start] + [
        {"kind": "step", "iteration": i, "seconds": s, "phase": "exploration"} for i, s in steps
    ]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert state_of(path).rate == pytest.approx(5.0)
    assert state_of(path).label == f"{tmp_path.name}/log.jsonl"
    assert state_of(path).total is None
    write(tmp_path / "b.jsonl", 3, seed=4)
    assert state_of(tmp_path / "b.jsonl").label == "mcmc, seed 4"


def test_a_torn_last_line_is_left_out_and_nonsense_is_named(tmp_path: Path) -> None:
    path = write(tmp_path / "log.jsonl", 10)
    whole = path.read_bytes()
    path.write_bytes(whole + b'{"kind":"step","iteration":10,"sec')
    assert (state_of(path).state, state_of(path).iteration) == ("running", 9)
    path.write_bytes(whole + b"what is this\n" + whole.splitlines(keepends=True)[-1])
    broken = state_of(path)
    assert broken.state == "unreadable"
    assert "line 13" in broken.detail
    assert not broken.over


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.52, "0.5 s"), (42, "42 s"), (185, "3 min 05 s"), (7621, "2 h 07 min")],
)
def test_durations(seconds: float, text: str) -> None:
    assert duration(seconds) == text


# -- the page ----------------------------------------------------------------------------------


def test_the_page_needs_nothing_but_itself_and_escapes_what_logs_say(tmp_path: Path) -> None:
    path = write(tmp_path / "a.jsonl", 70, arm="<b>$x_1$ & co", seed=1)
    text = page([state_of(path)], "psnr", (b"wide", b"narrow"), every=7)
    found = Page(text)
    assert found.urls == [
        f"data:image/png;base64,{base64.b64encode(data).decode()}" for data in (b"narrow", b"wide")
    ]
    assert not re.findall(r"(?:https?:)?//\w", text)
    assert "default-src 'none'" in text
    assert "b" not in found.tags
    assert "&lt;b&gt;$x_1$ &amp; co, seed 1" in text
    assert "7000" in text
    assert found.reloads
    assert not Page(page([state_of(path)], "psnr", (b"", b""), every=None)).reloads


def test_the_card_says_where_the_run_is(tmp_path: Path) -> None:
    write(tmp_path / "a.jsonl", 70)
    text = page([state_of(tmp_path / "a.jsonl")], "psnr", (b"", b""), every=1)
    for said in ("69 of 100", "20.7", "exploitation", "accepted pairs</dt><dd>50.0%", "width: 69"):
        assert said in text
    assert "<title>1 run: 1 running</title>" in text
    waiting = page([state_of(tmp_path / "b.jsonl")], "psnr", (b"", b""), every=1, note="Nothing.")
    assert "no such file yet" in waiting
    assert "Nothing." in waiting


def test_a_metric_below_an_hour_of_silence_is_told(tmp_path: Path) -> None:
    path = write(tmp_path / "a.jsonl", 70, "interrupted")
    os.utime(path, (time.time() - 3700, time.time() - 3700))
    assert "1 h 01 min ago" in page([state_of(path)], "psnr", (b"", b""), every=1)


# -- the picture -------------------------------------------------------------------------------


def picture(data: bytes) -> Any:
    from matplotlib.image import imread

    return imread(io.BytesIO(data))[..., :3]


@needs_matplotlib
def test_pictures_show_every_run_in_its_colour(tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        write(tmp_path / f"{name}.jsonl", 70, arm=f"_{name}$")
    follower = Follower([tmp_path], tmp_path / "out", "psnr", 1, 1e9)
    follower.look()
    follower.draw()
    follower.write()
    wide, narrow = (
        picture(base64.b64decode(url.split(",")[1]))
        for url in reversed(live(tmp_path / "out").urls)
    )
    assert wide.shape[1] > 1.5 * narrow.shape[1]
    assert (picture((tmp_path / "out/live.png").read_bytes()) == wide).all()
    for image in (wide, narrow):
        for colour in ((0x33, 0x33, 0x33), (0x00, 0x72, 0xB2), (0xD5, 0x5E, 0x00)):
            near = abs(image * 255 - torch.tensor(colour).numpy()).max(axis=-1) < 3
            assert near.sum() > 200, colour


@needs_matplotlib
@pytest.mark.parametrize("value", [float("nan"), float("inf"), 0.0, -1.0])
def test_odd_values_are_drawn_or_left_out(tmp_path: Path, value: float) -> None:
    with RunLog(tmp_path / "a.jsonl") as log:
        for i in range(5):
            log.step(i, phase="exploration", loss=value, nu=value)
        log.evaluation(4, psnr=value)
    follower = Follower([tmp_path / "a.jsonl", tmp_path / "b.jsonl"], tmp_path, "psnr", 1, 1e9)
    follower.look()
    follower.draw()
    follower.write()
    assert picture((tmp_path / "live.png").read_bytes()).ndim == 3


@needs_matplotlib
@pytest.mark.parametrize("highest", [0.06, 0.4, 20.0, 5e4])
def test_the_loss_has_plain_numbers_at_its_axis(highest: float) -> None:
    """Powers of ten with a factor would push the panels' labels out of the picture."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure()
    panel = figure.subplots()
    panel.plot([0, 1], [0.05, highest])
    log_scale(panel)
    FigureCanvasAgg(figure).draw()
    assert panel.get_yscale() == "log"
    low, high = panel.get_ylim()
    major = panel.yaxis.get_major_ticks()
    shown = [tick.label1.get_text() for tick in major if low <= tick.get_loc() <= high]
    assert len(shown) >= 2
    assert all(re.fullmatch(r"[0-9.]+(e[-+]\d+)?", text) for text in shown)
    assert {tick.label1.get_text() for tick in panel.yaxis.get_minor_ticks()} <= {""}


def test_a_long_name_takes_columns_from_the_legend() -> None:
    assert legend_columns(["mcmc"] * 8, 11, most=4) == 4
    assert legend_columns(["mcmc", "x" * 32], 11, most=4) == 3
    assert legend_columns(["mcmc"] * 8, 4.4, most=2) == 2
    assert legend_columns(["mcmc", "x" * 32], 4.4, most=2) == 1
    assert legend_columns(["x" * 200], 4.4, most=2) == 1
    assert legend_columns([], 4.4, most=2) == 2


def test_nothing_to_draw_is_no_error(tmp_path: Path) -> None:
    (tmp_path / "empty.jsonl").write_text("")
    (tmp_path / "void").mkdir()
    for path in (tmp_path / "empty.jsonl", tmp_path / "void", tmp_path / "nowhere"):
        follower = Follower([path], tmp_path / "out", "psnr", 1, 1e9)
        follower.look()
        follower.draw()
        follower.write()
        assert [run.state for run in follower.runs] == ["waiting"]
        assert live(tmp_path / "out").urls == []
    if importlib.util.find_spec("matplotlib"):
        assert NOTHING_YET in live(tmp_path / "out").text


def test_without_matplotlib_the_page_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = builtins.__import__

    def hidden(name: str, *rest: Any) -> Any:
        if name.partition(".")[0] == "matplotlib":
            raise ModuleNotFoundError("no matplotlib", name=name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", hidden)
    write(tmp_path / "a.jsonl", 20, "finished")
    assert follow([tmp_path / "a.jsonl"], tmp_path / "out", every=0.05) == 0
    monkeypatch.undo()
    found = live(tmp_path / "out")
    assert NO_MATPLOTLIB in html.unescape(found.text)
    assert "19 of 100" in found.text
    assert not (tmp_path / "out/live.png").exists()


# -- following ---------------------------------------------------------------------------------


def test_only_what_has_changed_is_read_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from opt3dgs_optim import follow_state

    reads: list[str] = []
    monkeypatch.setattr(follow_state, "read_run", lambda p: (reads.append(p.name), read_run(p))[1])
    for name in ("a", "b"):
        write(tmp_path / f"{name}.jsonl", 5)
    follower = Follower([tmp_path], tmp_path, "psnr", 1, 1e9)
    assert follower.look()
    assert not follower.look()
    with RunLog(tmp_path / "b.jsonl") as log:
        log_steps(log, 5, 9)
    assert follower.look()
    assert reads == ["a.jsonl", "b.jsonl", "b.jsonl"]
    assert [run.iteration for run in follower.runs] == [4, 8]
    write(tmp_path / "c.jsonl", 3)  # a new run in the folder
    (tmp_path / "a.jsonl").unlink()  # and one started all over
    write(tmp_path / "a.jsonl", 2)
    assert follower.look()
    assert [run.iteration for run in follower.runs] == [1, 8, 2]


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pages without pictures, whose drawing takes seconds on a busy machine."""
    from opt3dgs_optim import follow as module

    monkeypatch.setattr(module, "draw_live", lambda *_, **__: b"")


@pytest.fixture
def following(tmp_path: Path, undrawn: None) -> Iterator[Any]:
    """A follower in a thread, for the runs `a` and `b`, which do not exist yet."""
    result: list[int] = []
    paths = [tmp_path / "a.jsonl", tmp_path / "b" / "b.jsonl"]
    thread = threading.Thread(
        target=lambda: result.append(follow(paths, tmp_path / "out", every=0.05)), daemon=True
    )
    thread.start()
    yield paths, tmp_path / "out", thread, result
    assert not thread.is_alive()


def seen(out: Path, text: str) -> Page:
    """Wait for the page to say `text`."""
    for _ in range(3000):
        if (out / "live.html").exists() and text in live(out).text:
            return live(out)
        time.sleep(0.05)
    raise AssertionError(f"never said {text!r}: {live(out).text[:3000]}")


def test_following_two_runs_to_their_end(following: Any) -> None:
    (a, b), out, thread, result = following
    assert seen(out, "2 runs: 2 waiting").reloads
    with RunLog(a, metadata={"arm": "first", "iterations": 100}) as log:
        log_steps(log, 0, 40)
        seen(out, "39 of 100")
        log_steps(log, 40, 100)
        log.event("finished", 99)
    seen(out, "2 runs: 1 finished, 1 waiting")
    write(b, 30, arm="second")
    with open(b, "ab") as file:  # killed while it wrote
        file.write(b'{"kind":"step","iterat')
    seen(out, "29 of 100")
    assert thread.is_alive()
    with RunLog.resume(b, iteration=20) as log:
        seen(out, "20 of 100")
        log_steps(log, 21, 100)
        log.event("finished", 99)
    thread.join(60)
    assert result == [0]
    last = live(out)
    assert "2 runs: 2 finished" in last.text
    assert not last.reloads


def test_a_folder_is_given_time_for_its_next_run(tmp_path: Path, undrawn: None) -> None:
    write(tmp_path / "runs/a.jsonl", 5, "finished")
    begin = time.monotonic()
    assert follow([tmp_path / "runs"], tmp_path / "out", every=0.05, grace=0.5) == 0
    assert time.monotonic() - begin >= 0.5
    begin = time.monotonic()
    timer = threading.Timer(0.3, write, (tmp_path / "runs/b.jsonl", 5, "finished"))
    timer.start()
    assert follow([tmp_path / "runs"], tmp_path / "out", every=0.05, grace=0.7) == 0
    timer.join()
    assert "2 runs: 2 finished" in live(tmp_path / "out").text
    assert time.monotonic() - begin >= 1.0


@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_leaves_the_last_page(tmp_path: Path, kind: signal.Signals) -> None:
    write(tmp_path / "a.jsonl", 20)
    command = [sys.executable, "-W", "error", "-m", "opt3dgs_optim.report", "--follow"]
    command += [str(tmp_path / "a.jsonl"), "-o", str(tmp_path / "out"), "--every", "60"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        seen(tmp_path / "out", "reloads every 60 s")
        process.send_signal(kind)
        out, error = process.communicate(timeout=60)
    finally:
        process.kill()
    assert (process.returncode, error) == (130, "")
    assert out == f"{tmp_path / 'out' / 'live.html'}\n"
    last = live(tmp_path / "out")
    assert "the last state" in last.text
    assert not last.reloads
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) in (
        ["live.html"],
        ["live.html", "live.png"],
    )


@pytest.mark.parametrize(
    ("option", "value"), [("--every", "0"), ("--every", "nan"), ("--patience", "-1")]
)
def test_bad_seconds_are_refused(
    tmp_path: Path, option: str, value: str, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--follow", "x.jsonl", "-o", str(tmp_path), option, value]
    assert report.main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"report: {option} {float(value)}: must be")
    assert error.count("\n") == 1


def test_a_folder_that_cannot_be_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    write(tmp_path / "a.jsonl", 2, "finished")
    assert report.main(["--follow", str(tmp_path / "a.jsonl"), "-o", str(tmp_path / "file")]) == 2
    assert capsys.readouterr().err.startswith("report: ")
