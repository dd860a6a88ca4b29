"""Train without a planned end, and end the one training at several lengths.

    python examples/benchmarks/open_end.py 5000 7500 10000 15000 30000 --scene scenes/lego \\
        --size images_4 --points 10000 --background white

At five sixths of each length the state is kept, and `finish_in` ends the training; from the kept
state it goes on to the next. Each end is written as `train.py` writes a finished training, into the
folder `--out`. The trainer plans no end either: it relocates every 25 iterations until then, and
the rate of the positions, which sets the noise, falls as 1 / (1 + i / 200) in iteration i.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torch
from splatting.arms import find_arm
from splatting.density import MCMCDensityControl
from splatting.fit import Fit
from splatting.stopping import check_folder, command
from torch import Tensor
from tqdm import trange

from benchmarks import evidence, train
from opt3dgs_optim import PhaseScheduler

SHORTEST = 60  # iterations
FALL = 6  # the fall is a sixth of the training, a fifth of what is before it
HALVED = 200  # the iteration in which the positions' rate is half of its first value
REFINE_START, REFINE_EVERY = 100, 25


class OpenFit(Fit):
    """`Fit`, in which nothing is planned by the length of the training."""

    phases: PhaseScheduler

    def _density_control(self) -> MCMCDensityControl:
        return MCMCDensityControl(
            self.options.points,
            REFINE_START,
            self.options.iterations,
            REFINE_EVERY,
            generator=self.draws["density"],
        )

    def step(self) -> Tensor:
        """One iteration, whose rate of the positions is by the iterations so far."""
        group = self.optimizers["means"].param_groups[0]
        group["lr"] = self.rates["means"] / (1 + self.iteration / HALVED)
        return super().step()

    def end_at(self, iterations: int) -> None:
        """Begin the fall to the end."""
        self.phases.finish_in(iterations - self.iteration)
        assert isinstance(self.density, MCMCDensityControl)
        self.density.refine_stop = self.iteration


def train_to(fit: Fit, iterations: int) -> float:
    """Train until so many iterations have been made; the seconds that it took."""
    begin = time.process_time()
    for _ in trange(fit.iteration, iterations, unit="it"):
        fit.step()
    return time.process_time() - begin


def parser() -> argparse.ArgumentParser:
    """The options that `train.py` has, too, and the ends."""
    made = argparse.ArgumentParser(
        description=(__doc__ or "").splitlines()[0], parents=[train.shared()]
    )
    made.add_argument("ends", nargs="+", type=int, metavar="ITERATIONS", help="lengths, ascending")
    made.set_defaults(out=Path("runs/open-end"), arm="open-end", density=evidence.RELOCATION)
    made.set_defaults(sh_degree=0, threshold=1.0)
    return made


@command("open_end")
def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    args = parser().parse_args(arguments)
    torch.set_num_threads(1)
    ends, scene = args.ends, train.scene_of(args)
    if sorted(set(ends)) != ends or ends[0] < SHORTEST:
        raise ValueError(f"ends {ends}: ascending numbers, {SHORTEST} or more, are needed")
    args.iterations = ends[-1]
    options = train.options_of(args)
    lpips = args.lpips and train.lpips_of(*args.lpips)
    name = f"{scene.name}-{args.size}-{args.seed}"
    check_folder(args.out)
    state = args.out / f"{name}.pt"
    fit, seconds = OpenFit(scene, find_arm(args.arm), options), 0.0
    fit.compile_kernels()
    for end in ends:
        seconds += train_to(fit, end - end // FALL)
        fit.save(state)
        fit.end_at(end)
        fall = train_to(fit, end)
        args.iterations = end
        record = train.record_of(args, scene)
        words = evidence.command_of(record).replace(f" --arm {args.arm}", "")
        words = words.replace(f" --iterations {end}", "")
        record["command"] = words.replace("train.py", " ".join(map(str, ["open_end.py", *ends])))
        record |= {"finished": True, "curve": [train.look(fit, seconds + fall, lpips)]}
        out = args.out / f"{name}-{end}.json"
        out.write_text(json.dumps(record), encoding="utf-8")
        print(out, f"{record['curve'][-1]['psnr']:.2f} dB", flush=True)
        if end < ends[-1]:
            fit = OpenFit(scene, find_arm(args.arm), options)
            fit.load(state)
    state.unlink()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
