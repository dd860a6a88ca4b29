"""`benchmarks/simple_trainer.py`: gsplat's own script, stock and with the lines, as evidence."""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path

import pytest
from benchmarks import evidence, simple_trainer
from trials import TRAINERS, TRIALS, missing

STOCK, OURS = "{}:stock:300:400:0", "{}:defaults:300:400:1"


@pytest.mark.parametrize(
    ("training", "said"),
    [
        ("banana:ours:300:400:0", "scene:arm:iterations:cap:seed is needed"),
        ("banana:stock:300:0:0", "scene:arm:iterations:cap:seed is needed"),
        ("banana:stock:60:400:0", "a multiple of 10 is needed, 300 or more"),
        ("lego:stock:300:400:0", "a scene with the folders images, sparse/0, images_4 is needed"),
    ],
)
def test_what_is_refused(
    training: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("banana/images", "banana/images_4", "banana/sparse/0", "lego/images", "gsplat"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "out/scenes/banana").mkdir(parents=True)  # its small copy
    (tmp_path / "gsplat/version.py").write_text('__version__ = "1.5.3"\n')
    words = [str(tmp_path), str(tmp_path), training, "--cpu", "-o", str(tmp_path / "out")]
    assert simple_trainer.main(words) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out/evidence.jsonl").exists()


def test_a_training_is_stopped_fails_or_is_not_begun(tmp_path: Path) -> None:
    def ran(code: str, seconds: float) -> str:
        stop = time.monotonic() + seconds
        return simple_trainer.train([sys.executable, "-c", code], tmp_path, {**os.environ}, stop)

    begin = time.monotonic()
    assert ran("import time; time.sleep(60)", 0.5) == "stopped"
    assert time.monotonic() - begin < 30
    assert ran("raise KeyError('a')", 60) == "failed, KeyError: 'a'"
    assert ran("", 60) == ""
    assert ran("", 0) == "not begun"


@pytest.mark.hosts
def test_gsplats_script_becomes_evidence_and_is_resumed(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trial = next(each for each in TRIALS if each.name == "gsplat-1.5.3 mcmc")
    if (why := missing(trial)) is not None:
        pytest.skip(why)
    gsplat, out = TRAINERS / trial.trainer, tmp_path / "out"
    trainings = [each.format(scene.name) for each in (STOCK, OURS)]
    words = [str(gsplat), str(scene.parent), *trainings, "--cpu", "-o", str(out)]
    assert simple_trainer.main([*words, "--limit", "0.01"]) == 1
    assert not (out / "evidence.jsonl").exists()
    assert simple_trainer.main(words) == 0
    printed, written = capsys.readouterr().out, (out / "evidence.jsonl").read_bytes()
    ours, stock = evidence.read(out / "evidence.jsonl")
    own = (gsplat / "examples/simple_trainer.py").read_bytes()
    for line, name in ((stock, trainings[0]), (ours, trainings[1])):
        folder = out / name.replace(":", "-")
        val = json.loads((folder / "stats/val_step0299.json").read_text())
        assert (line["psnr"], line["lpips"]) == (round(val["psnr"], 5), None)
        assert (line["gaussians"], line["host"], line["rotated"]) == (400, "gsplat 1.5.3", False)
        assert f"| {name} | {line['psnr']:.2f} / " in printed
        is_stock = line is stock
        assert ((folder / "simple_trainer.py").read_bytes() == own) is is_stock
        said = "opt3dgs_optim: 300 iterations" in (folder / "log.txt").read_text()
        assert said is not is_stock
    assert simple_trainer.main(words) == 0  # nothing is trained again
    assert (out / "evidence.jsonl").read_bytes() == written
    assert (gsplat / "examples/simple_trainer.py").read_bytes() == own
