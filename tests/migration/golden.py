"""Digests of parameters and state after 60 steps: what a rebuilt core must reproduce.

    python tests/migration/golden.py write FILE.json
    python tests/migration/golden.py check FILE.json [--only SUBSTRING]

Every case x Adam flavour x scenario is a training of 37 points with six optimizers, gsplat's
learning rates and a switch to exploitation at step 40. Digests pin a torch version and a machine:
this is a tool of one migration. `check` exits with 1 where parameters or moments differ; the
curvature history is compared too, but its layout may change.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import platform
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import torch
from adapter import CASES, FLAVOURS, IS_NEW, Arm, gaussians, make
from torch import Tensor
from torch.optim.lr_scheduler import ExponentialLR

NUM_POINTS, TOTAL_STEPS, SWITCH = 37, 60, 40
SCENARIOS = ("plain", "row edit", "resume", "masked", "nan rows", "nan loss")
EDITS = (25, 47)  # one in each phase; after the steps of these iterations
SAVES = (30, 50)
NAN_LOSSES = (17, 44)
MOMENTS = ("exp_avg", "exp_avg_sq", "step")
NO_HISTORY = (*MOMENTS, "max_exp_avg_sq", "row_steps")
TRACE = 5  # steps between two short digests, which tell from where on a run differs
Run = dict[str, Any]


def skipped(case: str, scenario: str) -> str | None:
    """Why a combination is left out, or None."""
    if case == "torch" and scenario in ("masked", "nan rows", "nan loss"):
        return "not a thing of torch's Adam"
    return None


class Training:
    """A scene of 59 numbers per point, seen in part by each view, and its six optimizers."""

    def __init__(self, case: str, flavour: str) -> None:
        self.case, self.flavour = case, flavour
        self.params: dict[str, Any] = dict(gaussians(NUM_POINTS))
        shift = gaussians(NUM_POINTS, seed=1)
        self.targets = {
            name: (param + 0.1 * shift[name]).detach() for name, param in self.params.items()
        }
        self.arm, self.decay = self.fresh()

    def fresh(self) -> tuple[Arm, ExponentialLR]:
        arm = make(self.case, self.params, self.flavour, TOTAL_STEPS, SWITCH)
        decay = ExponentialLR(arm.optimizers["means"], 0.01 ** (1 / TOTAL_STEPS))
        return arm, decay

    def iterate(self, iteration: int, scenario: str) -> None:
        """One iteration, as a trainer makes it."""
        generator = torch.Generator().manual_seed(1000 + iteration)
        num_points = len(self.params["means"])
        visible = torch.rand(num_points, generator=generator) < 0.6
        brightness = 0.5 + torch.rand((), generator=generator)
        rows = [
            ((param - self.targets[name]) * brightness)[visible].flatten(1)
            if param.dim() > 1
            else ((param - self.targets[name]) * brightness)[visible, None]
            for name, param in self.params.items()
        ]
        stiffness = 2.0 ** torch.arange(-1, 2).repeat(20)[:59]
        render = torch.cat(rows, dim=1) * stiffness
        loss = self.arm.pixel_loss(render, torch.zeros_like(render))
        loss.backward()
        for name, param in self.params.items():
            noise = torch.randn(param.shape, generator=generator)
            noise[~visible] = 0.0
            param.grad.add_(noise, alpha=2e-5)
            if name in ("scales", "opacities"):  # 3DGS-MCMC's regularisers reach every point
                param.grad.add_(1e-6)
        if scenario == "nan rows" and iteration % 7 == 3:
            for name, row in (("means", 2), ("means", 5), ("opacities", 1), ("shN", 4)):
                self.params[name].grad[row].view(-1)[0] = torch.nan
        if scenario == "nan loss" and iteration in NAN_LOSSES:
            loss = loss * torch.nan
        self.arm.observe(loss)
        options = {"visible": visible} if scenario == "masked" else {}
        for optimizer in self.arm.optimizers.values():
            optimizer.step(**options)
            optimizer.zero_grad(set_to_none=True)
        self.decay.step()
        if scenario == "row edit" and iteration in EDITS:
            self.edit(torch.rand(num_points, generator=generator))
        if scenario == "resume" and iteration in SAVES:
            self.resume()

    def edit(self, draw: Tensor) -> None:
        """Double some rows and prune others, in two edits, as gsplat's strategies do."""
        chosen = (draw < 0.2).nonzero()[:, 0]
        self._edit_rows(
            lambda x: torch.cat([x, x[chosen]]),
            lambda x: torch.cat([x, x.new_zeros(len(chosen), *x.shape[1:])]),
        )
        kept = torch.cat([draw, draw[chosen]]) < 0.85
        self._edit_rows(lambda x: x[kept], lambda x: x[kept])

    def _edit_rows(self, of_param: Any, of_state: Any) -> None:
        for name, optimizer in self.arm.optimizers.items():
            old = self.params[name]
            new = torch.nn.Parameter(of_param(old.detach()))
            state = optimizer.state.pop(old)
            for key in state:
                if key != "step":
                    state[key] = of_state(state[key])
            optimizer.param_groups[0]["params"] = [new]
            optimizer.state[new] = state
            self.params[name] = new
            self.targets[name] = of_param(self.targets[name])

    def resume(self) -> None:
        """Everything anew, from a file."""
        file = io.BytesIO()
        saved = {
            "params": {name: param.detach() for name, param in self.params.items()},
            "optimizers": self.arm.state_dict(),
            "decay": self.decay.state_dict(),
        }
        torch.save(saved, file)
        file.seek(0)
        loaded = torch.load(file, weights_only=True)
        self.params = {name: torch.nn.Parameter(p) for name, p in loaded["params"].items()}
        self.arm, self.decay = self.fresh()
        self.arm.load_state_dict(loaded["optimizers"])
        self.decay.load_state_dict(loaded["decay"])

    # -- digests -------------------------------------------------------------------------------

    def states(self) -> dict[str, dict[str, Any]]:
        """State of every parameter."""
        optimizers = self.arm.optimizers
        return {name: optimizers[name].state.get(p, {}) for name, p in self.params.items()}

    def digests(self) -> Run:
        """Digests, and enough numbers to say how far off another run is."""
        moments, history = {}, {}
        for name, state in self.states().items():
            for key, value in state.items():
                if key in MOMENTS:
                    moments[f"{name}.{key}"] = torch.as_tensor(value, dtype=torch.float32)
                elif key not in NO_HISTORY:
                    history[f"{name}.{key}"] = value
        return {
            "params": digest(self.params),
            "moments": digest(moments),
            "history": digest(history) if history else None,
            "sums": {name: float(p.detach().double().sum()) for name, p in self.params.items()},
            "some": {name: some_of(p) for name, p in self.params.items()},
        }


def digest(tensors: dict[str, Any]) -> str:
    """SHA-256 over names, shapes and bytes."""
    total = hashlib.sha256()
    for name in sorted(tensors):
        value = torch.as_tensor(tensors[name]).detach().contiguous()
        total.update(f"{name} {tuple(value.shape)} {value.dtype}".encode())
        total.update(value.reshape(-1).view(torch.uint8).numpy().tobytes())
    return total.hexdigest()


def some_of(param: Tensor) -> list[float]:
    """Four coordinates spread over a parameter, to nine digits: float32 exactly."""
    flat = param.detach().reshape(-1)
    places = [(len(flat) - 1) * i // 3 for i in range(4)]
    return [float(f"{float(flat[i]):.9g}") for i in places]


def train(case: str, flavour: str, scenario: str) -> Run:
    """A run; what it raises is its result."""
    reason = skipped(case, scenario)
    if reason is not None:
        return {"skipped": reason}
    torch.manual_seed(7)
    trace = []
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            training = Training(case, flavour)
            for iteration in range(TOTAL_STEPS):
                training.iterate(iteration, scenario)
                if (iteration + 1) % TRACE == 0:
                    trace.append(digest(training.params)[:8])
    except Exception as error:  # (a combination that is refused)
        return {"raised": f"{type(error).__name__}: {error}"}
    return {**training.digests(), "trace": " ".join(trace)}


def names_of_runs(only: str) -> list[str]:
    """`case/scenario/flavour` of every run that has `only` in it."""
    names = [f"{c}/{s}/{f}" for c in CASES for s in SCENARIOS for f in FLAVOURS]
    return [name for name in names if only in name]


def run_named(name: str) -> Run:
    """The run of a name."""
    case, scenario, flavour = name.split("/")
    return train(case, flavour, scenario)


def machine() -> dict[str, str]:
    """What the digests belong to."""
    return {
        "torch": torch.__version__,
        "machine": platform.machine(),
        "capability": torch.backends.cpu.get_cpu_capability(),
    }


def all_runs(only: str) -> dict[str, Run]:
    """All runs, with a line of progress."""
    names, begin, runs = names_of_runs(only), time.perf_counter(), {}
    for done, name in enumerate(names, 1):
        runs[name] = run_named(name)
        print(f"\r{done}/{len(names)} {name:<50}", end="", file=sys.stderr, flush=True)
    print(f"\n{time.perf_counter() - begin:.0f} s", file=sys.stderr)
    return runs


def write(path: Path, only: str) -> int:
    """Write all digests, a line a run."""
    runs = all_runs(only)
    lines = [f"{json.dumps(name)}: {json.dumps(run)}" for name, run in runs.items()]
    body = ",\n".join(lines)
    path.write_text(f'{{"machine": {json.dumps(machine())},\n"runs": {{\n{body}\n}}}}\n')
    print_table({name: verdict(run, run) for name, run in runs.items()})
    for line in surprises(runs):
        print(line)
    return 0


def surprises(runs: dict[str, Run]) -> list[str]:
    """What should not be: a resumed run is the plain one, nothing on is torch's Adam, and
    whatever is on changes something.
    """
    found, seen = [], {}

    def params(name: str) -> Any:
        return runs.get(name, {}).get("params")

    for name in runs:
        case, scenario, flavour = name.split("/")
        if scenario == "resume" and params(name) != params(f"{case}/plain/{flavour}"):
            found.append(f"not as the plain run: {name}")
        if (
            case == "torch"
            and params(name)
            and params(name) != params(f"nothing/{scenario}/{flavour}")
        ):
            found.append(f"not as with nothing on: {name}")
        if scenario == "plain" and flavour == "default" and params(name):
            other = seen.setdefault(params(name), name)
            if other != name and {other, name} != {"torch/plain/default", "nothing/plain/default"}:
                found.append(f"alike: {other} and {name}")
    return found


def verdict(old: Run, new: Run) -> str:
    """`equal`, or what differs, in capitals where it counts."""
    for key in ("skipped", "raised"):
        if key in new and key in old:
            return key
        if key in new or key in old:
            return key.upper()
    wrong = [key.upper() for key in ("params", "moments") if old[key] != new[key]]
    if wrong:
        return "+".join(wrong)
    return "equal" if old["history"] == new["history"] else "equal (history)"


def distance(old: Run, new: Run) -> str:
    """How far apart two runs are, and from when on."""
    if "params" not in old or "params" not in new:
        shown = [run.get("raised") or run.get("skipped") or "runs" for run in (old, new)]
        return f"was: {shown[0]}; is: {shown[1]}"
    a, b = old["trace"].split(), new["trace"].split()
    since = next((i for i, (x, y) in enumerate(zip(a, b, strict=True)) if x != y), None)
    when = (
        "in no trace" if since is None else f"in steps {since * TRACE + 1}..{TRACE * (since + 1)}"
    )
    far = {
        name: max(abs(x - y) for x, y in zip(old["some"][name], new["some"][name], strict=True))
        for name in old["some"]
    }
    sums = {name: abs(old["sums"][name] - new["sums"][name]) for name in old["sums"]}
    shown = ", ".join(f"{name} {far[name]:.1e} ({sums[name]:.1e})" for name in far)
    return f"first {when}; largest of 4 coordinates (of sums): {shown}"


def print_table(verdicts: dict[str, str]) -> None:
    """A row per case and scenario, a column per flavour."""
    print(f"| {'case':<18}| {'scenario':<9}| " + " | ".join(f"{f:<16}" for f in FLAVOURS) + " |")
    print(f"|{'-' * 19}|{'-' * 10}|" + f"{'-' * 18}|" * len(FLAVOURS))
    for case in CASES:
        for scenario in SCENARIOS:
            cells = [verdicts.get(f"{case}/{scenario}/{flavour}", "") for flavour in FLAVOURS]
            if any(cells):
                row = " | ".join(f"{cell:<16}" for cell in cells)
                print(f"| {case:<18}| {scenario:<9}| {row} |")


def check(path: Path, only: str) -> int:
    """Compare with the file; 1 where parameters or moments differ."""
    saved = json.loads(path.read_text())
    if saved["machine"] != machine():
        print(f"written on {saved['machine']}, but this is {machine()}: digests may differ")
    runs = all_runs(only)
    verdicts = {name: verdict(saved["runs"][name], run) for name, run in runs.items()}
    print_table(verdicts)
    differing = [name for name, text in verdicts.items() if text != text.lower()]
    for name in differing:
        print(f"{name}: {distance(saved['runs'][name], runs[name])}")
    print(f"{'parts' if IS_NEW else 'options'}: {len(differing)} of {len(runs)} runs differ")
    return 1 if differing else 0


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("what", choices=("write", "check"))
    parser.add_argument("file", type=Path)
    parser.add_argument("--only", default="", help="runs with this in case/scenario/flavour")
    options = parser.parse_args()
    torch.set_num_threads(1)
    return (write if options.what == "write" else check)(options.file, options.only)


if __name__ == "__main__":
    sys.exit(main())
