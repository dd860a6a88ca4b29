"""gsplat's own `simple_trainer.py mcmc` on a GPU, stock and with the defaults, in limited time.

    python examples/benchmarks/simple_trainer.py GSPLAT SCENES bonsai:stock:30000:200000:0 \\
        bonsai:defaults:10000:200000:0 bonsai:defaults:15000:200000:0 --limit 800

GSPLAT is a checkout whose gsplat and whose examples' requirements are installed, SCENES a folder of
scenes. A training is scene:arm:iterations:cap:seed; they begin in this order, two at a time. The
script runs as it is (`stock`) or with the lines of `opt3dgs lines` (`defaults`), in a copy, with
the schedule of `opt3dgs lines gsplat --iterations N`. It has no option for its seed, 42: for
seed N the copy has 42 + N. Every eighth photo is held out, whatever the seed. Finished trainings
are lines of `evidence.jsonl` in `--out` and are not run again; what the limit stops begins anew.
Seconds are the trainer's own, up to the save before its last step, what it compiles included.

The script reads `images` and COLMAP's `sparse/0`; a scene with `transforms.json` alone is refused.
It draws on black, so that a scene on white is another one here. LPIPS' network is downloaded once.
`--cpu` tries it all without a GPU, by `hosts/cpu`, with photos of an eighth of the size and a
twelfth of the points: 300 iterations, the fewest, of a small scene. They show no quality.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(1, str(Path(__file__).resolve().parents[1] / "hosts" / "cpu"))

import torch
from splatting.stopping import check_folder, command
from tqdm import tqdm
from trials import ON_CPU, copy_scene

from benchmarks import evidence, report, steps
from opt3dgs_optim.hosts import diff
from opt3dgs_optim.hosts.schedules import STOCK, schedule, shortened
from opt3dgs_optim.hosts.trainers import TRAINERS

FORM = re.compile(r"([\w.-]+):(stock|defaults):(\d+):([1-9]\d*):(\d+)")
SEED = "set_random_seed(42 + local_rank)"
AT_ONCE = 2  # more trainings make no more iterations in all
Line = evidence.Line


def line_of(text: str, gsplat: Path, cpu: bool) -> Line:
    """The line of a training, but for what it ends with."""
    if (found := FORM.fullmatch(text)) is None:
        raise ValueError(f"{text}: scene:arm:iterations:cap:seed is needed, arm stock or defaults")
    version = (gsplat / "gsplat" / "version.py").read_text(encoding="utf-8").split('"')[-2]
    said = f"python examples/benchmarks/simple_trainer.py GSPLAT SCENES{cpu * ' --cpu'} {text}"
    return {
        **{"scene": found[1], "size": "images_8" if cpu else "images", "density": "relocation"},
        **{"arm": found[2], "iterations": int(found[3]), "points": int(found[4]), "sh_degree": 3},
        **{"seed": int(found[5]), "rotated": False, "host": f"gsplat {version}"},
        **{"device": steps.machine(torch.device("cpu" if cpu else "cuda"))},
        **{"date": time.strftime("%Y-%m-%d", time.gmtime()), "note": "up to two at a time"},
        "command": said,
    }


def scene_of(folder: Path, out: Path, cpu: bool) -> Path:
    """The scene as it is, or a small copy of it."""
    needs = ["images", "sparse/0", *["images_4"] * cpu]
    if not all((folder / name).is_dir() for name in needs):
        raise ValueError(f"{folder}: a scene with the folders {', '.join(needs)} is needed")
    small = out / "scenes" / folder.name
    return folder if not cpu else small if small.is_dir() else copy_scene(folder, small)


def words_of(line: Line, gsplat: Path, scene: Path, folder: Path, cpu: bool) -> list[str]:
    """The command of a training in its folder, and the copy of the script that it runs."""
    stock = schedule(TRAINERS["gsplat"]) or ""  # `mcmc` first
    printed = shortened(stock, line["iterations"]).partition("simple_trainer.py ")[2]
    printed = printed.partition("\n")[0]
    ours = f"--data_factor {4 if cpu else 1} --test_every 8 --sh_degree 3 --result_dir ."
    ours += f" --strategy.cap_max {line['points']} --disable_viewer --disable_video"
    ours += f" --eval_steps {STOCK} --save_steps {STOCK}"  # at the end: these are scaled as well
    text = (gsplat / "examples" / "simple_trainer.py").read_bytes().decode()
    if text.count(SEED) != 1:
        raise ValueError(f"{gsplat}: its simple_trainer.py has not one `{SEED}`")
    text = text.replace(SEED, SEED.replace("42", str(42 + line["seed"])))
    folder.mkdir(exist_ok=True)
    script = folder / "simple_trainer.py"
    script.write_bytes((text if line["arm"] == "stock" else diff.edited(text)[1]).encode())
    options = [str(scene) if w == "SCENE" else w for w in shlex.split(f"{printed} {ours}")]
    return [sys.executable, *[str(ON_CPU)] * cpu, str(script), *options]


def train(words: list[str], folder: Path, env: dict[str, str], stop: float) -> str:
    """Run a training; what kept it from its end, or nothing."""
    if time.monotonic() >= stop:
        return "not begun"
    with (
        (folder / "log.txt").open("wb") as log,
        subprocess.Popen(words, cwd=folder, env=env, stdout=log, stderr=log) as process,
    ):
        try:
            code = process.wait(stop - time.monotonic())
        except subprocess.TimeoutExpired:
            process.terminate()
            return "stopped"
    said = (folder / "log.txt").read_text(encoding="utf-8", errors="replace").strip()
    return f"failed, {said[said.rfind(chr(10)) + 1 :] or 'no output'}" if code else ""


def ends_of(line: Line, stats: Path) -> Line:
    """The line with what the trainer has written of its end; on a CPU LPIPS is NaN."""
    last = line["iterations"] - 1
    names = f"val_step{last:04d}.json", f"train_step{last:04d}_rank0.json"
    val, trained = (json.loads((stats / name).read_text(encoding="utf-8")) for name in names)
    made = {m: round(val[m], 5) if math.isfinite(val[m]) else None for m in report.METRICS}
    return line | made | {"seconds": round(trained["ellipse_time"], 2), "gaussians": val["num_GS"]}


@command("simple_trainer")
def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; 1 where a training is not finished."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    add = parser.add_argument
    add("gsplat", type=Path, metavar="GSPLAT", help="a checkout of gsplat")
    add("scenes", type=Path, metavar="SCENES", help="a folder of scenes")
    add("trainings", nargs="+", metavar="TRAINING", help="scene:arm:iterations:cap:seed")
    add("--limit", type=float, default=800.0, metavar="SECONDS", help="then all is stopped")
    add("--cpu", action="store_true", help="try it without a GPU")
    add("-o", "--out", type=Path, default=Path("runs/simple_trainer"), metavar="DIR")
    args = parser.parse_args(arguments)
    stop, cpu = time.monotonic() + args.limit, args.cpu
    if not cpu and not torch.cuda.is_available():
        raise ValueError("torch sees no CUDA device; --cpu tries it without one")
    gsplat, scenes, out = (path.resolve() for path in (args.gsplat, args.scenes, args.out))
    lines = [line_of(text, gsplat, cpu) for text in args.trainings]
    asked, file, jobs = {evidence.key_of(x): x for x in lines}, out / "evidence.jsonl", {}
    check_folder(out)
    done = {evidence.key_of(x) for x in evidence.read(file)}
    for line in (x for key, x in asked.items() if key not in done):
        folder = out / line["command"].split()[-1].replace(":", "-")
        scene = scene_of(scenes / line["scene"], out, cpu)
        jobs[folder] = line, words_of(line, gsplat, scene, folder, cpu)
    path = [gsplat / "examples", *[gsplat] * cpu, os.environ.get("PYTHONPATH", "")]
    env = {"CUDA_VISIBLE_DEVICES": "0", **os.environ, "OMP_NUM_THREADS": "1"}  # else all GPUs
    env["PYTHONPATH"] = os.pathsep.join(map(str, path))
    pool = ThreadPoolExecutor(AT_ONCE)
    begun = {pool.submit(train, words, f, env, stop): f for f, (_, words) in jobs.items()}
    try:
        for each in tqdm(as_completed(begun), total=len(begun), unit="training"):
            folder, why = begun[each], each.result()
            tqdm.write(f"{folder.name}: {why or 'finished'}")
            if not why:
                evidence.add([ends_of(jobs[folder][0], folder / "stats")], file)
    finally:
        pool.shutdown(cancel_futures=True)
    rows = []
    for line in (x for x in evidence.read(file) if evidence.key_of(x) in asked):
        end, seconds = report.numbers(report.mean([line])), f"{line['seconds']:.0f} s"
        rows.append((line["command"].split()[-1], end, f"{line['gaussians']:,}", seconds))
    print(report.table(("training", "PSNR / SSIM / LPIPS", "Gaussians", "took"), rows))
    return int(len(rows) < len(asked))


if __name__ == "__main__":
    raise SystemExit(main())
