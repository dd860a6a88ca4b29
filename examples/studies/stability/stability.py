"""Stiff problems with known minima: how far, how fast and up to which condition each method gets.

    python examples/studies/stability/stability.py            # docs/results/stability/, its page
    python examples/studies/stability/stability.py --tables   # the same from the last run's JSON

torch's Adam and LBFGS, AWSGLD, LQNAdam, and the two-loop recursion of LQNAdam with a line search
instead of Adam. Every problem is a batch of rows in axes of their own; torch's LBFGS, which knows
one vector only, gets an optimizer per row. Adam, AWSGLD and LQNAdam get the best of three learning
rates (1, 10 and 100 thousandths of the distance to the minimum), decayed to 1e-6 of it.

The page also shows the long tests, the coverage and the mutants. `--slow` and `--coverage` take in
what pytest has left (`--junitxml`, `--cov-report=json`); tests/mutants.py writes its own.
"""

from __future__ import annotations

import argparse
import json
import math
import platform
import sys
import time
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from opt3dgs_optim import AWSGLD, EnergyHistogram, LQNAdam

ROOT = Path(__file__).resolve().parents[3]
PAGE = ROOT / "docs" / "results" / "stability" / "stability.md"
sys.path[:0] = [str(ROOT / p) for p in ("examples", "tests", "tests/support")]  # their problems

from line_search import minimise  # noqa: E402
from problems import (  # noqa: E402
    MULTIMODAL,
    SMOOTH,
    Problem,
    gradient,
    hessians,
    placed,
    quadratic,
    rotations,
    to_world,
)

from studies.pages import filled  # noqa: E402
from studies.stability.stability_page import (  # noqa: E402
    MARK,
    coverage_result,
    slow_result,
    table,
    texts,
)

Function = Callable[[Tensor], Tensor]
Course = list[tuple[int, float, float]]  # iteration, seconds, error
Step = Callable[[], Tensor]  # takes one iteration, returns the rows' points
SHARES = (1e-3, 1e-2, 1e-1)
ARMS = ("Adam", "AWSGLD", "LQNAdam", "LBFGS (torch)", "two-loop + line search")
CONDITIONS = (1.0, 1e1, 1e2, 1e3, 1e4, 1e6, 1e9, 1e12)
LBFGS_ROWS = 4
# Several valleys. The double well's start is a minimum.
VALLEYS = tuple(problem for problem in MULTIMODAL if problem.start != problem.minimum)


def adam_like(arm: str, value: Function, start: Tensor, lr: float, steps: int) -> Step:
    """One step of an Adam over all rows, its learning rate decayed to 1e-6 of `lr`."""
    x = torch.nn.Parameter(start.clone())
    histogram = EnergyHistogram(warmup=max(4, steps // 12))
    optimizer: torch.optim.Optimizer = {
        "Adam": lambda: torch.optim.Adam([x], lr=lr, eps=1e-30),
        "AWSGLD": lambda: AWSGLD([x], lr=lr, eps=1e-30, histogram=histogram),
        "LQNAdam": lambda: LQNAdam([x], lr=lr, eps=1e-30),
    }[arm]()
    decay = torch.optim.lr_scheduler.ExponentialLR(optimizer, 1e-6 ** (1 / steps))

    def step() -> Tensor:
        loss = value(x)
        (x.grad,) = torch.autograd.grad(loss.sum(), x)
        if arm == "AWSGLD":
            histogram.observe(loss.detach().mean())
        optimizer.step()
        decay.step()
        return x.detach()

    return step


def torch_lbfgs(value: Function, start: Tensor) -> Step:
    """One iteration of torch's LBFGS (history 5, strong Wolfe) for each of the first rows."""
    rows = [torch.nn.Parameter(start[i : i + 1].clone()) for i in range(LBFGS_ROWS)]
    # max_eval: its default of 1.25 max_iter leaves a line search one evaluation.
    options: dict[str, Any] = {"max_iter": 1, "max_eval": 50, "history_size": 5}
    options |= {"tolerance_grad": 0.0, "tolerance_change": 0.0, "line_search_fn": "strong_wolfe"}
    optimizers = [torch.optim.LBFGS([x], **options) for x in rows]

    def step() -> Tensor:
        for i, (x, optimizer) in enumerate(zip(rows, optimizers, strict=True)):

            def closure(x: Tensor = x, i: int = i) -> Tensor:
                everything = torch.cat([start[:i], x, start[i + 1 :]])
                loss = value(everything)[i]
                (x.grad,) = torch.autograd.grad(loss, x)
                return loss

            optimizer.step(closure)  # pyright: ignore[reportArgumentType]
        return torch.cat([x.detach() for x in rows])

    return step


def timed(step: Step, error: Callable[[Tensor], float], steps: int) -> Course:
    """The error after each of `steps` iterations, and the seconds of the iterations alone."""
    course, seconds = [], 0.0
    for iteration in range(1, steps + 1):
        begin = time.perf_counter()
        x = step()
        seconds += time.perf_counter() - begin
        if iteration <= 20 or iteration % 10 == 0:
            course.append((iteration, seconds, error(x)))
    return course


def compare(
    value: Function, start: Tensor, distance: float, error: Callable[[Tensor], float], steps: int
) -> dict[str, Course]:
    """The course of every arm; of the three learning rates, the one that ends best."""
    courses: dict[str, Course] = {}
    for arm in ARMS[:3]:
        tried = [
            timed(adam_like(arm, value, start, share * distance, steps), error, steps)
            for share in SHARES
        ]
        courses[arm] = min(tried, key=lambda course: course[-1][2])
    courses[ARMS[3]] = timed(torch_lbfgs(value, start), error, min(steps, 150))
    begin = time.perf_counter()
    points = minimise(value, start, min(steps, 150))
    each = (time.perf_counter() - begin) / len(points)
    courses[ARMS[4]] = [(i, i * each, error(x)) for i, x in enumerate(points, start=1)]
    return courses


def problem_courses(problem: Problem, rows: int, steps: int) -> dict[str, Course]:
    turn, scale = rotations(rows, problem.dim), torch.ones(rows, dtype=torch.float64)
    value = placed(problem, scale, turn)
    start = to_world(problem.starts(rows), scale, turn)
    distance = float((problem.minima(1) - problem.starts(1)).norm())

    def error(x: Tensor) -> float:
        many = len(x)
        found = placed(problem, scale[:many], turn[:many])(x)
        height = problem.start_value - problem.minimum_value
        return max(float((found - problem.minimum_value).median()) / height, 1e-40)

    return compare(value, start, distance, error, steps)


def condition_courses(condition: float, rows: int, steps: int) -> dict[str, Course]:
    start = torch.ones(rows, 3, dtype=torch.float64)

    def error(x: Tensor) -> float:
        return max(float((x.norm(dim=1) / 3**0.5).median()), 1e-40)

    return compare(quadratic(hessians(rows, condition)), start, 3**0.5, error, steps)


def range_survived() -> dict[str, float]:
    """Decades of gradient size over which one step in float32 is that at size 1, to 1 %."""
    found = {}
    for arm in ("Adam", "LQNAdam"):
        good = 0
        for exponent in range(-44, 38):
            ends = []
            for size in (1.0, 10.0**exponent):
                x = torch.nn.Parameter(torch.ones(100, 3))
                cls: Any = torch.optim.Adam if arm == "Adam" else LQNAdam
                optimizer = cls([x], lr=0.01, eps=0.0)
                for _ in range(5):
                    x.grad = gradient(lambda p: (p**2).sum(1), x) / 2 * size
                    optimizer.step()
                ends.append(x.detach())
            good += bool(((ends[0] - ends[1]).abs().max() < 1e-4).item())
        found[arm] = good
    return found


# -- what is written -------------------------------------------------------------------------------


def digits(error: float) -> str:
    found = -math.log10(error)
    return "> 30" if found > 30 else f"{found + 0.0:.1f}".replace("-0.0", "0.0")


def reached(course: Course) -> str:
    """The digits at the end and, where the error falls to 1e-6, the iterations until then."""
    hits = [iteration for iteration, _, error in course if error < 1e-6]
    return digits(course[-1][2]) + (f" ({hits[0]})" if hits else "")


def report(results: dict[str, Any]) -> str:
    """The page's tables."""
    about = results["about"]
    decades = ", ".join(f"{arm} {count}" for arm, count in results["decades"].items())

    def comparison(kind: str, cell: Callable[[Course], str]) -> str:
        rows = [(name, *(cell(c[arm]) for arm in ARMS)) for name, c in results[kind].items()]
        return table(("problem", *ARMS), rows)

    return f"""Made by `{about["command"]}` on {about["date"]}: {about["machine"]}, \
{about["rows"]} rows, {about["steps"]} steps (line searches: up to 150).

### Digits reached (-log10 of f over its start), and iterations to six

{comparison("problems", reached)}
### Several valleys: what is left of f above its lowest minimum, over that of the start

{comparison("valleys", lambda c: f"{c[-1][2]:.2f}")}
### Quadratics: digits reached (-log10 of |x| over its start)

{comparison("quadratics", lambda c: digits(c[-1][2]))}
Decades of gradient size (of 82, 1e-44 to 1e37; float32) with the same steps: {decades}.
"""


def measured(rows: int, steps: int, machine: str) -> dict[str, Any]:
    """Every arm on every problem."""
    sizes = (rows, steps)
    problems = {p.name: problem_courses(p, *sizes) for p in tqdm(SMOOTH, desc="problems")}
    valleys = {p.name: problem_courses(p, *sizes) for p in tqdm(VALLEYS, desc="valleys")}
    quadratics = {
        f"condition {c:.0e}": condition_courses(c, *sizes)
        for c in tqdm(CONDITIONS, desc="quadratics")
    }
    command = "python examples/studies/stability/stability.py"
    about = {"command": command, "date": date.today().isoformat(), "machine": machine}
    about |= {"rows": rows, "steps": steps}
    results = {"about": about, "problems": problems, "valleys": valleys, "quadratics": quadratics}
    return results | {"decades": range_survived()}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rows", type=int, default=50)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--tables", action="store_true", help="measure nothing")
    parser.add_argument("--slow", type=Path, nargs="+", metavar="XML", help="of the long tests")
    parser.add_argument("--coverage", type=Path, metavar="JSON", help="report of coverage.py")
    parser.add_argument("--note", default="", help="what the coverage is of, if not of all tests")
    options = parser.parse_args()
    torch.set_num_threads(1)
    folder = PAGE.parent
    machine = f"{platform.system()} {platform.machine()}, torch {torch.__version__}"
    if options.slow:
        found = slow_result(options.slow, machine)
        (folder / "slow.json").write_text(json.dumps(found, indent=1) + "\n")
    if options.coverage:
        found = coverage_result(options.coverage, machine, options.note)
        (folder / "coverage.json").write_text(json.dumps(found, indent=1) + "\n")
    if not (options.tables or options.slow or options.coverage):
        results = measured(options.rows, options.steps, f"{machine}, 1 thread")
        (folder / "stability.json").write_text(json.dumps(results) + "\n")
    results = json.loads((folder / "stability.json").read_text())
    made = texts(folder, report(results))
    PAGE.write_text(filled(PAGE.read_text(), made, MARK))
    print(f"wrote {folder} and {PAGE}")


if __name__ == "__main__":
    main()
