"""What is outside of the contract is refused, or told once: with the value, and what to do."""

from __future__ import annotations

import copy
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import pytest
import torch
from gaussians import adam_of, adams_of, parameters, steps
from torch.nn import Parameter
from torch.optim import Adam

from opt3dgs_optim import (
    DEFAULTS,
    Averaging,
    Curvature,
    EnergyHistogram,
    Fading,
    LQNAdam,
    OwnFrame,
    Part,
    PhaseScheduler,
)
from opt3dgs_optim import phases as module
from opt3dgs_optim.messages import End

ROWS = 4


def one(value: Any = None, name: str = "means", **options: Any) -> Adam:
    """A stock Adam of one tensor."""
    param = Parameter(torch.ones(ROWS, 3) if value is None else value)
    return Adam([{"params": [param], "name": name}], **{"lr": 0.01, **options})


class Foreign(Adam):
    """An Adam with a step that is not torch's."""

    def step(self, closure: Any = None) -> None: ...


def two_tensors() -> Adam:
    return Adam([{"params": [Parameter(torch.ones(ROWS, 3)) for _ in "ab"], "name": "xyz"}])


def with_option(option: str) -> Adam:
    optimizer = one()
    optimizer.param_groups[0][option] = True
    return optimizer


OPTIMIZERS: dict[str, tuple[Callable[[], Any], type[Exception], str]] = {
    "another optimizer": (
        lambda: torch.optim.SGD([Parameter(torch.ones(ROWS, 3))], lr=0.1),
        TypeError,
        "SGD has a step of its own; have the trainer make a torch.optim.Adam",
    ),
    "others, in a dict": (
        lambda: {"means": one(), "camera": torch.optim.SGD([Parameter(torch.ones(3))], lr=0.1)},
        TypeError,
        "SGD has a step of its own.*; or leave 'camera' out, which holds no Gaussians",
    ),
    "a foreign step": (lambda: Foreign(one().param_groups), TypeError, "Foreign has a step of its"),
    "a model": (
        lambda: torch.nn.ParameterDict({"means": torch.ones(ROWS, 3)}),
        TypeError,
        r"ParameterDict is no optimizer; pass the one that .* \(gaussians.optimizer, say\)",
    ),
    "others, in a list": (
        lambda: [one(), torch.optim.SGD([Parameter(torch.ones(3))], lr=0.1)],
        TypeError,
        "SGD has a step of its own.*; or leave it out, which holds no Gaussians",
    ),
    "half precision": (
        lambda: one(torch.ones(ROWS, 3, dtype=torch.bfloat16)),
        ValueError,
        "means is torch.bfloat16.*dense float32 is needed",
    ),
    "several devices": (
        lambda: Adam(
            [
                {"params": [Parameter(torch.ones(ROWS, 3))], "name": "xyz"},
                {"params": [Parameter(torch.ones(ROWS, 3, device="meta"))], "name": "scaling"},
            ]
        ),
        ValueError,
        "parameters lie on .'cpu', 'meta'.; one device is needed",
    ),
    "a tensor as lr": (lambda: one(lr=torch.tensor(0.1)), ValueError, "a tensor as lr; give a flo"),
    "two tensors in a group": (two_tensors, ValueError, "xyz holds 2 tensors; give each Gaussian"),
    "positions of another shape": (
        lambda: one(torch.ones(ROWS, 4, 3)),
        ValueError,
        r"means is \(4, 4, 3\); Gaussian parameters have a row .*, and positions are \[N, 3\]",
    ),
    "one with parts": (
        lambda: LQNAdam([{"params": [Parameter(torch.ones(ROWS, 3))], "name": "means"}]),
        TypeError,
        "LQNAdam has parts of its own; upgrade a torch.optim.Adam, with parts=",
    ),
    "no Gaussians": (
        lambda: one(name="mlp"),
        ValueError,
        "no Gaussians among the groups .'mlp'.; name the groups, or the keys of a dict",
    ),
    "names twice": (
        lambda: [one(name="xyz"), one(name="means")],
        ValueError,
        "'means' is held twice; for two sets of Gaussians name the groups",
    ),
    **{
        option: (
            lambda option=option: with_option(option),
            ValueError,
            f"means has {option}=True; make the Adam without it",
        )
        for option in ("amsgrad", "maximize", "differentiable", "capturable")
    },
}


@pytest.mark.parametrize("what", OPTIMIZERS)
def test_optimizers_that_are_refused(what: str) -> None:
    make, kind, said = OPTIMIZERS[what]
    given = make()
    classes = [type(each) for each in (given if isinstance(given, list) else [given])]
    with pytest.raises(kind, match=said):
        PhaseScheduler(100).upgrade(given)
    assert classes == [type(each) for each in (given if isinstance(given, list) else [given])]


def test_a_group_that_comes_later_is_refused_too() -> None:
    optimizer = PhaseScheduler(100).upgrade(one())
    with pytest.raises(ValueError, match="scales has amsgrad=True; make the Adam without it"):
        optimizer.add_param_group(
            {"params": [Parameter(torch.ones(ROWS, 3))], "name": "scales", "amsgrad": True}
        )
    with pytest.raises(ValueError, match=r"two groups hold the same of \['means'\]"):
        optimizer.add_param_group({"params": [Parameter(torch.ones(ROWS, 3))], "name": "xyz"})
    assert len(optimizer.param_groups) == 1
    optimizer.add_param_group({"params": [Parameter(torch.ones(ROWS, 3))], "name": "scales"})
    assert optimizer._slots[1] == ("", "scales")  # pyright: ignore


def test_two_sets_under_one_name_are_told(recwarn: pytest.WarningsRecorder) -> None:
    """Where both are stepped; not where one takes the place of another, which steps no more."""
    params = parameters(ROWS, "means")
    for before in (0, 3):
        phases = PhaseScheduler(100, parts=[Averaging()])
        first = phases.upgrade(phases.upgrade(adams_of(params)))
        steps(first, params, before)
        second = phases.upgrade(adams_of(params))
        steps(second, params, 3)
        assert not recwarn.list
        with pytest.warns(UserWarning, match="another optimizer holds means, too, and was upgra"):
            steps(first, params, 1)
        steps(first, params, 1)
        assert len(recwarn.list) == 0


def test_an_optimizer_that_is_made_anew_is_missed(recwarn: pytest.WarningsRecorder) -> None:
    """Also of a parameter that no part looks for; but no set of Gaussians that is gone."""
    params = parameters(ROWS)
    phases = PhaseScheduler(300)
    optimizers = phases.upgrade(adams_of(params))
    other = phases.upgrade({"sky#means": one(name="sky#means"), "sky#sh0": one(name="sky#sh0")})
    steps(optimizers, params, 90)
    del other
    steps(optimizers, params, 20)
    assert not recwarn.list
    optimizers["opacities"] = adams_of({"opacities": params["opacities"]})["opacities"]
    with pytest.warns(UserWarning, match=r"the optimizer of \['opacities'\] has gone; if another"):
        steps(optimizers, params, 100)


def test_the_clock_goes_on_where_the_optimizer_of_the_positions_is_made_anew(
    recwarn: pytest.WarningsRecorder,
) -> None:
    """And it is told, as soon as numbers are looked at."""
    params = parameters(ROWS)
    phases = PhaseScheduler(300)
    optimizers = phases.upgrade(adams_of(params))
    steps(optimizers, params, 50)
    optimizers["means"] = adams_of({"means": params["means"]})["means"]
    with pytest.warns(
        UserWarning, match=r"the optimizer of \['means'\] has gone; if another is in"
    ):
        steps(optimizers, params, 100)
    assert phases.iteration == 149
    assert len(recwarn.list) == 0


def test_an_optimizer_of_the_positions_alone_takes_none_of_the_others(recwarn: Any) -> None:
    """The first goes on with what is left to it."""
    params = parameters(ROWS)
    phases = PhaseScheduler(300)
    first = phases.upgrade(adam_of(params))
    steps({"all": first}, params, 3)
    second = phases.upgrade(adam_of({"means": params["means"]}))
    for _ in range(3):
        steps({"means": second}, {"means": params["means"]}, 1)
        params["means"].grad = None
        first.step()
    assert all(phases.param_of("", name) is param for name, param in params.items())
    assert phases.iteration == 5
    assert not recwarn.list


def test_a_clock_goes_on_where_positions_are_trained_no_more() -> None:
    params = parameters(ROWS)
    phases = PhaseScheduler(300)
    optimizer = phases.upgrade(adam_of(params))
    steps({"all": optimizer}, params, 30)
    del params["means"]
    optimizer = phases.upgrade(adam_of(params))
    with pytest.warns(
        UserWarning, match=r"the optimizer of \['means'\] has gone; if another is in"
    ):
        steps({"all": optimizer}, params, 80)
    assert phases.iteration == 109


def part(**attributes: Any) -> PhaseScheduler:
    """A scheduler of one part with these attributes."""
    attributes = {"plan": lambda *_: None, **attributes}
    return PhaseScheduler(100, parts=[type("Mine", (Part,), attributes)()])


SCHEDULERS: dict[str, tuple[Callable[[], Any], type[Exception], str]] = {
    "no length": (lambda: PhaseScheduler(0), ValueError, "total_steps=0, but an integer at least"),
    "a share beyond": (
        lambda: PhaseScheduler(100, switch=1.5),
        ValueError,
        "switch=1.5.*is needed",
    ),
    "parts second": (
        lambda: PhaseScheduler(100, [Averaging()]),  # pyright: ignore
        TypeError,
        "takes from 1 to 2 positional arguments but 3 were given",
    ),
    "a class": (
        lambda: PhaseScheduler(100, parts=[Averaging]),  # pyright: ignore
        TypeError,
        r"write parts=\[Averaging\(\)\]",
    ),
    "INRIA's names": (
        lambda: part(names=("opacity", "f_dc")),
        ValueError,
        r"Mine: names=\('opacity', 'f_dc'\), but a tuple of means, .*shN is needed",
    ),
    "other names": (lambda: part(names=("means", "mlp")), ValueError, "Mine: names=.* is needed"),
    "no names": (
        lambda: PhaseScheduler(100, parts=[Fading(names=())]),
        ValueError,
        r"Fading: names=\(\), but a tuple of means",
    ),
    "a name": (lambda: part(names="means"), ValueError, "Mine: names='means', but a tuple of"),
    "a phase": (lambda: part(during="exploration"), ValueError, "during='exploration', but None"),
    "not saved": (
        lambda: part(state_dict=lambda _: {}),
        ValueError,
        "Mine has a state_dict, but is not saved; set learns = True",
    ),
    "of an older Part": (
        lambda: part(plan=Part.plan, before=lambda *_: None),
        ValueError,
        "Mine has none of plan, after, observe, pixel_loss, numbers, so that it would never act",
    ),
    "a kind twice": (
        lambda: PhaseScheduler(100, parts=[OwnFrame(), type("Mine", (OwnFrame,), {})()]),
        ValueError,
        "OwnFrame is there twice in parts",
    ),
    "a name twice": (
        lambda: PhaseScheduler(
            100, parts=[Averaging(), type("Averaging", (Part,), {"after": print})()]
        ),
        ValueError,
        "Averaging is there twice in parts; give one part of each class",
    ),
    "no star": (
        lambda: PhaseScheduler(100, parts=[DEFAULTS, Averaging()]),  # pyright: ignore
        TypeError,
        r"no Part object; write a star before it, parts=\[\*DEFAULTS, ",
    ),
    "one part": (
        lambda: PhaseScheduler(100, parts=Averaging()),  # pyright: ignore
        TypeError,
        r"a list of parts is needed, parts=\[Averaging\(\)\]",
    ),
    "own frame and curvature": (
        lambda: PhaseScheduler(100, parts=[OwnFrame(), Curvature()]),
        ValueError,
        "leave one of the two out",
    ),
}


@pytest.mark.parametrize("what", SCHEDULERS)
def test_schedulers_that_are_refused(what: str) -> None:
    make, kind, said = SCHEDULERS[what]
    with pytest.raises(kind, match=said):
        make()


@pytest.mark.parametrize(
    ("iteration", "said"),
    [
        (6, "iteration=6, but the clock stands at 7 of 100 and goes forward, to 200"),
        (201, "iteration=201, but the clock stands at 7 of 100"),
        (-1, "iteration=-1, but an integer at least 0"),
        (8.5, "iteration=8.5, but an integer"),
    ],
)
def test_the_clock_goes_forward_within_the_run(iteration: Any, said: str) -> None:
    phases = PhaseScheduler(100)
    phases.upgrade(one())
    phases.observe(iteration=7)
    with pytest.raises(ValueError, match=said):
        phases.observe(iteration=iteration)
    assert phases.iteration == 7


def test_a_count_is_no_loss_and_comes_after_upgrade() -> None:
    phases = PhaseScheduler(100)
    with pytest.raises(ValueError, match=r"iteration=7 before upgrade.*; call it below"):
        phases.observe(iteration=7)
    phases.upgrade(one())
    with pytest.raises(ValueError, match=r"loss=7, an integer.* write observe\(iteration=7\)"):
        phases.observe(7)
    assert phases.iteration == -1


@pytest.mark.parametrize(
    "loss", [torch.ones(2), "0.1", [1.0, 2.0], 1j, torch.ones((), dtype=torch.cfloat)]
)
def test_a_loss_is_one_real_number(loss: Any) -> None:
    with pytest.raises(ValueError, match=r"observe: loss=.*one real number is needed"):
        PhaseScheduler(100).observe(loss)


def test_images_of_two_shapes() -> None:
    with pytest.raises(ValueError, match=r"render has shape \(2, 3\) and target \(3, 2\)"):
        PhaseScheduler(100).pixel_loss(torch.ones(2, 3), torch.ones(3, 2))


@pytest.mark.filterwarnings("ignore:EnergyHistogram. no energy")
@pytest.mark.parametrize("reads", [True, False])
def test_several_ranks_are_told_where_a_part_reads_the_loss(
    monkeypatch: pytest.MonkeyPatch, reads: bool, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(module, "num_ranks", lambda: 2)
    caplog.set_level("INFO", logger="opt3dgs_optim")
    params = parameters(ROWS, "means")
    parts: list[Part] = [EnergyHistogram() if reads else Averaging()]
    steps(PhaseScheduler(100, parts=parts).upgrade(adams_of(params)), params, 3)
    told = "2 ranks train: EnergyHistogram needs the same loss in all; give observe() its mean"
    assert caplog.text.count(told) == reads


def test_a_run_that_is_longer_than_it_was_said(recwarn: pytest.WarningsRecorder) -> None:
    params = parameters(ROWS, "means")
    steps(PhaseScheduler(10, parts=[Fading()]).upgrade(adams_of(params)), params, 14)
    found = [str(each.message) for each in recwarn]
    assert len(found) == 1
    assert "iteration 11 of total_steps=10" in found[0]
    assert "pass the number of steps that it makes as total_steps" in found[0]


def test_numbers_that_are_not_finite_are_told_once(recwarn: pytest.WarningsRecorder) -> None:
    params = parameters(ROWS, "means")
    optimizers = PhaseScheduler(500, parts=[Averaging()]).upgrade(adams_of(params))
    for _ in range(250):
        params["means"].grad = torch.full((ROWS, 3), torch.nan)
        optimizers["means"].step()
    found = [str(each.message) for each in recwarn]
    assert len(found) == 1
    assert "iteration 100: 1200 numbers of gradients have not been finite" in found[0]
    assert "look for the first NaN of the loss" in found[0]


def test_numbers_that_are_not_finite_are_told_where_a_training_goes_back() -> None:
    """To a checkpoint, in the same process."""
    params = parameters(ROWS, "means")
    optimizer = PhaseScheduler(900, parts=[Averaging()]).upgrade(adam_of(params))
    steps({"all": optimizer}, params, 10)
    saved = copy.deepcopy(optimizer.state_dict())
    steps({"all": optimizer}, params, 500)
    optimizer.load_state_dict(saved)
    params["means"].grad = torch.full((ROWS, 3), torch.nan)
    for _ in range(100):
        optimizer.step()
    with pytest.warns(UserWarning, match=f"iteration 110: {3 * ROWS * 100} numbers of gradients"):
        optimizer.step()


@pytest.mark.parametrize(("finite", "bad"), [(0, 76), (78, 1)])
def test_numbers_that_are_not_finite_are_told_before_the_end(finite: int, bad: int) -> None:
    """Of a training that ends between two looks, and where only the last ones are not."""
    params = parameters(ROWS, "means")
    optimizers = PhaseScheduler(80, parts=[Averaging()]).upgrade(adams_of(params))
    steps(optimizers, params, finite)
    params["means"].grad = torch.full((ROWS, 3), torch.nan)
    for _ in range(bad):
        optimizers["means"].step()
    said = f"iteration {finite + bad}: {3 * ROWS * bad} numbers of gradients"
    with pytest.warns(UserWarning, match=said):
        optimizers["means"].step()


def test_positions_of_a_name_that_is_not_known() -> None:
    params = parameters(ROWS, "scales", "quats")
    given = adams_of(params) | {"mu": Adam([Parameter(torch.ones(ROWS, 3))], lr=0.01)}
    with pytest.warns(UserWarning, match=r"the groups \['mu'\] have a row for each Gaussian"):
        optimizers = PhaseScheduler(80).upgrade(given)
    with pytest.warns(UserWarning, match="no optimizer holds positions.*name their group"):
        steps(optimizers, params, 3)


@pytest.mark.parametrize(
    ("total", "done", "finished", "said"),
    [
        (600, 5, False, True),
        (600, 585, False, True),
        (600, 599, False, False),
        (600, 585, True, False),
        (20, 20, False, False),  # too short for a mean
    ],
)
def test_a_training_that_ends_early(total: int, done: int, finished: bool, said: bool) -> None:
    params = parameters(ROWS, "means")
    phases = PhaseScheduler(total, parts=[Averaging()])
    steps(phases.upgrade(adams_of(params)), params, done)
    if finished:
        phases.finish()
    line = phases.end_line()
    assert (line is not None) == said
    assert line is None or (f"iteration {done} of 600" in line and "phases.finish()" in line)


def test_lines_below_the_loop() -> None:
    """The optimizer has made its steps before, and makes no other."""
    params = parameters(ROWS, "means")
    steps(adams := adams_of(params), params, 3)
    phases = PhaseScheduler(600, parts=[Averaging()])
    phases.upgrade(adams)
    assert "have made no step; upgrade those that the training steps" in str(phases.end_line())


def test_optimizers_that_make_no_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """As where the trainer makes its optimizers after `upgrade`."""
    told: list[Any] = []
    monkeypatch.setattr(End, "say", lambda end, line=None: told.append(line or end.line()))
    params = parameters(ROWS, "means")
    phases = PhaseScheduler(600, parts=[Averaging()])
    assert "its upgrade(optimizers) was not called" in str(phases.end_line())
    upgraded = phases.upgrade(adams_of(params))
    steps(adams_of(params), params, 3)
    assert "have made no step; upgrade those that the training steps" in str(phases.end_line())
    assert not told
    del upgraded  # as where a trainer makes others to load a checkpoint
    assert len(told) == 1
    assert "are gone before their first step; upgrade those that are made in their place" in told[0]
    assert phases.end_line() is None  # it is said
    phases.upgrade(adams := adams_of(params))
    steps(adams, params, 3)
    assert "ended at iteration 3 of 600" in str(phases.end_line())


def test_a_child_that_imports_the_training_again_says_nothing(monkeypatch: Any) -> None:
    """As workers of a DataLoader do, where processes are spawned."""
    monkeypatch.setattr("multiprocessing.parent_process", lambda: "the training")
    assert PhaseScheduler(600).end_line() is None


def test_a_schedule_that_another_takes_over_says_no_more() -> None:
    params = parameters(ROWS, "means")
    first = PhaseScheduler(600, parts=[Averaging()])
    optimizers = first.upgrade(adams_of(params))
    steps(optimizers, params, 5)
    PhaseScheduler(600, parts=[Averaging()]).upgrade(optimizers)
    assert first.end_line() is None


def test_finish_of_a_resumed_training_before_there_is_a_mean(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """And a checkpoint that is loaded to be looked at has no line at the end."""
    params = parameters(ROWS, "means")
    trained = PhaseScheduler(600, parts=[Averaging()]).upgrade(adams_of(params))
    steps(trained, params, 5)
    phases = PhaseScheduler(600, parts=[Averaging()])
    phases.upgrade(adams_of(params))["means"].load_state_dict(trained["means"].state_dict())
    assert phases.end_line() is None
    phases.finish()
    said = "finish() at iteration 5: averaging begins at 580 of 600, anew where rows are edited"
    assert f"{said}, and the parameters stay the last iterate" in caplog.text
    optimizers = phases.upgrade(adams_of(params))
    optimizers["means"].load_state_dict(trained["means"].state_dict())
    steps(optimizers, params, 3)
    assert "ended at iteration 8 of 600" in str(phases.end_line())


@pytest.mark.processes
@pytest.mark.parametrize("error", ["", "raise MemoryError"])
def test_the_early_end_is_said_at_exit(error: str) -> None:
    """And not where an error is what ended it."""
    code = f"""
import torch
from opt3dgs_optim import PhaseScheduler
p = torch.nn.Parameter(torch.zeros(5, 3))
phases = PhaseScheduler(600, parts=None)
adam = phases.upgrade({{"opacities": torch.optim.Adam([p])}})["opacities"]
for _ in range(585):
    p.grad = torch.ones(5, 3)
    adam.step()
{error}
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    begun = "600 iterations, OwnFrame, Fading, OutOfView, Averaging, in the steps of opacities"
    assert done.stderr.startswith(f"opt3dgs_optim: {begun}\n")
    assert ("the training ended at iteration 585 of 600" in done.stderr) is not bool(error)
    assert done.returncode == bool(error)
    assert done.stdout == ""
