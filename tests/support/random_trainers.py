"""Random training scripts: loops of every shape, with what they do recorded as they run.

A script is written as text by `Shape.script`, edited by `hosts diff`, and run with stand-ins for
the package and the trainer's modules. The stand-ins are made here: a scheduler that notes what it
is told, an optimizer that notes its steps, a loss.
"""

from __future__ import annotations

import sys
import types
from dataclasses import dataclass, field
from typing import Any

FIRSTS = {  # how the first iteration is written, and what it is; {n} is its value
    "literal": ("", "{n}"),
    "name": ("first = {n}\n", "first"),
    "two values": ("first = 0\nif {n} > 0:\n    first = {n}\n", "first"),
    "incremented": ("first = {n} - 1\nfirst += 1\n", "first"),
    "sum": ("first = {n} - 1\n", "first + 1"),
}
LASTS = {  # how the end is written; {n} is the range's end
    "literal": ("", "{n}"),
    "name": ("last = {n}\n", "last"),
    "attribute": ("opt.iterations = {n}\n", "opt.iterations"),
    "plus one": ("opt.iterations = {n} - 1\n", "opt.iterations + 1"),
    "product": ("opt.iterations = {n}\n", "1 * opt.iterations"),
}
OVER = {  # what the loop goes over; {r} is the range
    "bare": ("", "{r}"),
    "tqdm": ("", "tqdm({r}, desc='training')"),
    "module": ("", "tqdm.tqdm({r})"),
    "name": ("bar = {r}\n", "bar"),
    "wrapped name": ("bar = {r}\nbar = tqdm(bar)\n", "bar"),
    "if": ("", "tqdm({r}) if opt.quiet else {r}"),
    "two names": ("if opt.quiet:\n    bar = {r}\nelse:\n    bar = tqdm({r})\n", "bar"),
}
BODIES = {  # between the head of the loop and the step; {i} is the count
    "plain": "loss = loss_of()\nloss.backward()\n",
    "skips": "if {i} % 3 == 1:\n    continue\nloss = loss_of()\nloss.backward()\n",
    "sometimes": "loss = loss_of()\nif {i} % 2 == 0:\n    loss.backward()\n",
    "with": "with context():\n    loss = loss_of()\n    loss.backward()\n",
    "try": "try:\n    loss = loss_of()\n    loss.backward()\nfinally:\n    pass\n",
    "fails": (
        "try:\n    fails({i})\n    loss = loss_of()\n    loss.backward()\n"
        "except OverflowError:\n    continue\n"
    ),
    "two arms": (
        "loss = loss_of()\nif opt.quiet:\n    scaler.scale(loss).backward()\n"
        "else:\n    loss.backward()\n"
    ),
    "item": "losses = {{'total': loss_of()}}\nlosses['total'].backward()\n",
    "evaluates": (
        "loss = loss_of()\nfor view in range(2):\n    loss = loss_of()\nloss.backward()\n"
        "for {i2} in range(3):\n    pass\n"
    ),
    "micro": "for view in range(2):\n    loss = loss_of()\n    loss.backward()\n",
    "retries": "while True:\n    loss = loss_of()\n    loss.backward()\n    break\n",
    "one arm": (
        "loss = loss_of()\nif {i} % 2:\n    loss.backward()\nelif {i} % 3:\n    loss.backward()\n"
    ),
    "two losses": "loss = loss_of()\nloss.backward()\nmore = loss_of()\nmore.backward()\n",
    "recounts": "{i} = {i} // 2\nloss = loss_of()\nloss.backward()\n",
    "closure": (
        "def closure():\n    loss = loss_of()\n    loss.backward()\n    return loss\nclosure()\n"
    ),
}
STEPS = {
    "plain": "gaussians.optimizer.step()\n",
    "not the last": "if {i} < {end} - 1:\n    gaussians.optimizer.step()\n",
    "two arms": (
        "if opt.quiet:\n    gaussians.optimizer.step()\nelse:\n    gaussians.optimizer.step()\n"
    ),
    "every second": "if {i} % 2 == 0:\n    gaussians.optimizer.step()\n",
    "named": "due = {i} % 2 == 0\nif due:\n    gaussians.optimizer.step()\n",
    "continues": "if {i} % 2:\n    continue\ngaussians.optimizer.step()\n",
    "twice": "gaussians.optimizer.step()\ngaussians.optimizer.step()\n",
    "finally": "try:\n    fails(0)\nfinally:\n    gaussians.optimizer.step()\n",
    "inner": "for _ in range(2):\n    gaussians.optimizer.step()\n",
    "counted": (
        "opt.waiting = getattr(opt, 'waiting', 0) + 1\nif opt.waiting >= 2:\n"
        "    gaussians.optimizer.step()\n    opt.waiting = 0\n"
    ),
    "leaves": (
        "gaussians.optimizer.step()\ndone = False\nif {i} + 3 >= {end}:\n    done = True\n"
        "if done:\n    break\n"
    ),
}
AROUND = {  # around the whole loop
    "nothing": "{loop}",
    "epochs": "for epoch in range(2):\n{loop_in}",
    "while": "rounds = 0\nwhile rounds < 2:\n    rounds += 1\n{loop_in}",
    "with": "with context():\n{loop_in}",
    "try": "try:\n{loop_in}finally:\n    pass\n",
    "if": "if opt is not None:\n{loop_in}",
}
WHERE = {  # where the code stands
    "function": "def training(opt):\n{code}\n\ntraining(opt)\n",
    "main": "def main():\n{code}\n\nif __name__ == '__main__':\n    main()\n",
    "module": "{flat}",
    "guarded module": "if __name__ == '__main__':\n{code}",
    "method": (
        "class Runner:\n    def train(self, opt):\n{code2}\n\n"
        "runner = Runner()\nrunner.train(opt)\n"
    ),
    "nested": "def outer():\n    def inner(opt):\n{code2}\n    inner(opt)\n\nouter()\n",
    "repeated method": (
        "class Runner:\n    def epoch(self, opt):\n{code2}\n    def train(self, opt):\n"
        "        for _ in range(2):\n            self.epoch(opt)\n\n"
        "runner = Runner()\nrunner.train(opt)\n"
    ),
    "called twice": "def training(opt):\n{code}\n\ntraining(opt)\ntraining(opt)\n",
    "called in a loop": "def training(opt):\n{code}\n\nfor _ in range(2):\n    training(opt)\n",
}
# Loops that no number of iterations can be read from.
OTHER_LOOPS = (
    "for {i} in reversed({r}):",
    "for {i}, view in enumerate(loader):",
    "for view, {i} in enumerate({r}):",
    "for {i}, view in zip({r}, loader):",
    "for {i} in itertools.count():",
    "for {i} in generator():",
    "for {i} in loader:",
    "for {i} in sorted({r}):",
    "for {i} in range({end} - 1, -1, -1):",
)
OTHER_WHILES = ("while True:", "while {i} + 1 < {end}:")
NAMES = "opt, gaussians, loss_of, context, scaler, fails, loader, generator, tqdm, trainer_saw"
HEAD = f"import itertools\nfrom trainer import {NAMES}\n\n"


def indented(text: str, times: int = 1) -> str:
    """The lines of a text, moved to the right."""
    return "".join(f"{'    ' * times}{line}\n" for line in text.splitlines())


@dataclass(frozen=True)
class Shape:
    """One way to write a training loop."""

    first: str = "literal"
    last: str = "literal"
    over: str = "bare"
    body: str = "plain"
    step: str = "plain"
    around: str = "nothing"
    where: str = "function"
    start: int = 0
    end: int = 8
    stride: int = 1
    other: str = ""  # of OTHER_LOOPS or OTHER_WHILES, instead of a range
    name: str = "iteration"
    set_up: bool = False  # whether the function makes the optimizers itself

    def script(self) -> str:
        """The trainer's file."""
        before_first, first = FIRSTS[self.first]
        before_last, last = LASTS[self.last]
        before_over, over = OVER[self.over]
        numbers = f"{first.format(n=self.start)}, {last.format(n=self.end)}"
        if self.stride != 1:
            numbers += f", {self.stride}"
        elif self.start == 0 and self.first == "literal":
            numbers = last.format(n=self.end)
        text = f"range({numbers})"
        names = {"i": self.name, "i2": self.name, "end": self.end, "r": text}
        head = f"for {self.name} in {over.format(**names)}:"
        counted = ""
        if self.other:
            head = self.other.format(**names)
        if head.startswith("while"):
            counted = f"{self.name} += 1\n"
        body = f"{counted}trainer_saw({self.name})\n"
        body += (BODIES[self.body] + STEPS[self.step]).format(**names)
        if self.other == "for {i} in itertools.count():" or head == "while True:":
            body += f"if {self.name} >= {self.end} - 1:\n    break\n"
        before = before_first.format(n=self.start) + before_last.format(n=self.end)
        before += before_over.format(**names)
        if head.startswith("while"):
            before += f"{self.name} = -1\n"
        if self.set_up:
            before += "gaussians.training_setup(opt)\n"
        loop = f"{head}\n{indented(body)}"
        code = before + AROUND[self.around].format(loop=loop, loop_in=indented(loop))
        return HEAD + WHERE[self.where].format(
            code=indented(code), code2=indented(code, 2), flat=code
        )


@dataclass
class Seen:
    """What happened in a run, in its order."""

    events: list[tuple[str, Any]] = field(default_factory=list)

    def note(self, kind: str, value: Any = None) -> None:
        """Add an event."""
        self.events.append((kind, value))


class StandInScheduler:
    """Notes what the lines of `hosts diff` tell it."""

    seen: Seen

    def __init__(self, total_steps: int, parts: Any = None, process_group: Any = None) -> None:
        self.seen.note("total", total_steps)
        self.next_iteration = 0

    def upgrade(self, optimizers: Any) -> Any:
        """Return the argument."""
        return optimizers

    def observe(self, loss: Any, *, iteration: int | None = None) -> None:
        """Note the iteration, as `PhaseScheduler` counts it."""
        self.current = self.next_iteration if iteration is None else iteration
        self.next_iteration = self.current + 1
        self.seen.note("observe", self.current)


class _Anything:
    """A context manager, an optimizer, a loss: whatever a script needs."""

    def __init__(self, note: Any = None) -> None:
        self._note = note

    def __enter__(self) -> _Anything:
        return self

    def __exit__(self, *error: Any) -> None:
        return None

    def backward(self) -> None:
        """Note it."""
        self._note("backward")

    def step(self) -> None:
        """Note it."""
        self._note("step")

    def scale(self, loss: Any) -> Any:
        """As a GradScaler's."""
        return loss


def run(source: bytes) -> Seen:
    """Run a script, edited or not, and say what it did."""
    seen = Seen()

    def fails(iteration: int) -> None:
        if iteration % 3 == 2:
            raise OverflowError

    trainer: Any = types.ModuleType("trainer")
    options = types.SimpleNamespace(iterations=0, quiet=False)
    gaussians = types.SimpleNamespace(
        optimizer=_Anything(seen.note), training_setup=lambda opt: None
    )
    tqdm: Any = lambda source, **options: source  # noqa: E731
    tqdm.tqdm = tqdm
    names = {
        "opt": options,
        "gaussians": gaussians,
        "loss_of": lambda: _Anything(seen.note),
        "context": _Anything,
        "scaler": _Anything(),
        "fails": fails,
        "loader": range(8),
        "generator": lambda: iter(range(8)),
        "tqdm": tqdm,
        "trainer_saw": lambda iteration: seen.note("saw", iteration),
    }
    vars(trainer).update(names)
    ours: Any = types.ModuleType("opt3dgs_optim")
    ours.PhaseScheduler = type("PhaseScheduler", (StandInScheduler,), {"seen": seen})
    run_with({"trainer": trainer, "opt3dgs_optim": ours}, source)
    return seen


def run_with(modules: dict[str, Any], source: bytes) -> None:
    """Run a script that imports these modules in the place of those that there are."""
    before = {name: sys.modules.get(name) for name in modules}
    sys.modules.update(modules)
    try:
        exec(compile(source, "<trainer>", "exec"), {"__name__": "__main__"})
    finally:
        for name, module in before.items():
            if module is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module
