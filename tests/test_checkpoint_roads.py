"""Every road of a checkpoint: to disk, through torch.distributed, through the stock trainer.

After each, a training goes on bit for bit, or a warning says what begins anew.
"""

from __future__ import annotations

import contextlib
import copy
import io
import itertools
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import landed_checkpoints
import pytest
import torch
from placed_training import ROWS, Training, distance
from ranks import free_port
from torch import Tensor
from torch.distributed.checkpoint import state_dict as dcp_state
from torch.distributed.checkpoint.api import CheckpointException
from torch.distributed.checkpoint.default_planner import DefaultLoadPlanner
from torch.distributed.checkpoint.state_dict_loader import load as dcp_load
from torch.distributed.checkpoint.state_dict_saver import save as dcp_save
from torch.nn import Parameter

from opt3dgs_optim import Averaging, Curvature, PhaseScheduler
from opt3dgs_optim.names import GAUSSIAN

DATA = Path(__file__).parent / "data"
SINGLE = "torch.distributed is disabled"  # what DCP says of a single process
TORCHS = {"step", "exp_avg", "exp_avg_sq", "max_exp_avg_sq"}


pytestmark = pytest.mark.filterwarnings(f"ignore:{SINGLE}")


def reread(value: Any) -> Any:
    """Written by torch.save, read with weights_only."""
    torch.save(value, buffer := io.BytesIO())
    buffer.seek(0)
    return torch.load(buffer, weights_only=True)


class Model(torch.nn.Module):
    """The Gaussians as a module, which torch.distributed asks for their names."""

    def __init__(self, training: Training) -> None:
        super().__init__()
        self.splats = torch.nn.ParameterDict(training.splats)


@contextlib.contextmanager
def heard() -> Iterator[list[str]]:
    """The warnings that are given within."""
    said: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield said
    said += [str(each.message) for each in caught if not str(each.message).startswith(SINGLE)]


def begun(arm: str, first: Training | None = None, **options: Any) -> Training:
    """A training of one optimizer, from the other's parameters."""
    training = Training(arm, layout="single", **options)
    if first is not None:
        values = first.values()
        with torch.no_grad():
            for name, param in training.splats.items():
                param.copy_(values[name])
        training.iteration = first.iteration
    return training


# -- roads -----------------------------------------------------------------------------------------


def by_state_dict(first: Training, second: Training, folder: Path) -> None:
    second.optimizers.load_state_dict(first.optimizers.state_dict())


def by_torch_save(first: Training, second: Training, folder: Path) -> None:
    second.optimizers.load_state_dict(reread(first.optimizers.state_dict()))


def by_dcp(first: Training, second: Training, folder: Path, **options: Any) -> None:
    """`get_optimizer_state_dict` and `set_optimizer_state_dict`, single process."""
    asked = dcp_state.StateDictOptions(**options)
    models = Model(first), Model(second)
    saved = dcp_state.get_optimizer_state_dict(models[0], first.optimizers, options=asked)
    for param in second.splats.values():
        param.grad = None
    dcp_state.set_optimizer_state_dict(
        models[1], second.optimizers, optim_state_dict=reread(saved), options=asked
    )


def by_flat_dcp(first: Training, second: Training, folder: Path) -> None:
    by_dcp(first, second, folder, flatten_optimizer_state_dict=True)


def by_dcp_files(
    first: Training, second: Training, folder: Path, *, partial: bool = False, **options: Any
) -> None:
    """As `by_dcp`, through a checkpoint of DCP on disk, which reads what the reader asks for.

    `partial`: what the reader asks for and the files do not have stays as the reader has it.
    """
    asked = dcp_state.StateDictOptions(**options)
    saved = dcp_state.get_optimizer_state_dict(Model(first), first.optimizers, options=asked)
    dcp_save({"optimizer": saved}, checkpoint_id=folder, no_dist=True)
    model = Model(second)
    found = dcp_state.get_optimizer_state_dict(model, second.optimizers, options=asked)
    planner = DefaultLoadPlanner(allow_partial_load=partial)
    dcp_load({"optimizer": found}, checkpoint_id=folder, no_dist=True, planner=planner)
    dcp_state.set_optimizer_state_dict(
        model, second.optimizers, optim_state_dict=found, options=asked
    )


def by_flat_dcp_files(
    first: Training, second: Training, folder: Path, *, partial: bool = False
) -> None:
    by_dcp_files(first, second, folder, partial=partial, flatten_optimizer_state_dict=True)


ROADS: dict[str, Callable[..., None]] = {
    "state_dict": by_state_dict,
    "torch.save": by_torch_save,
    "DCP": by_dcp,
    "DCP flat": by_flat_dcp,
    "DCP files": by_dcp_files,
    "DCP flat files": by_flat_dcp_files,
}
# Iterations at which the arms keep most: in the last thirtieth, after the switch, in a warm-up.
AT = {"no parts": 20, "Fading": 21, "Averaging": 25, "EnergyHistogram": 30, "Curvature": 40}
AT |= {"FreshMoments": 36, "OutOfView": 20, "DEFAULTS": 88, "DEFAULTS_ADC": 88, "paper": 66}
ON_DISK = ("Averaging", "Curvature", "EnergyHistogram", "DEFAULTS", "paper")


def roads() -> list[tuple[str, str]]:
    every = itertools.product(AT, ROADS)
    return [(arm, road) for arm, road in every if "files" not in road or arm in ON_DISK]


@pytest.mark.parametrize(("arm", "road"), roads())
def test_a_training_goes_on_as_if_it_had_not_been_stopped(
    arm: str, road: str, tmp_path: Path
) -> None:
    first = begun(arm).run(AT[arm])
    second = begun(arm, first)
    with heard() as said:
        ROADS[road](first, second, tmp_path)
        clock = second.phases.iteration
        second.run()
    alike = distance(second.values(), begun(arm).run().values()) == 0.0
    if "DCP" not in road:
        assert alike
    assert clock == AT[arm] or said
    assert alike or any("anew" in each or "again" in each for each in said), said


# -- the stock trainer's checkpoints, and ours in the stock trainer ------------------------------


STOCK_AT, MORE = 40, 25


def moments(training: Training) -> dict[str, Tensor]:
    return {key: v for key, v in training.kept().items() if key.split(".", 1)[1] in TORCHS}


def assert_same_moments(ours: Training, theirs: Training) -> None:
    mine, expected = moments(ours), moments(theirs)
    assert set(mine) == set(expected)
    assert [key for key in mine if not torch.equal(mine[key], expected[key])] == []


@pytest.mark.parametrize("road", ROADS)
@pytest.mark.parametrize("arm", ["no parts", "DEFAULTS"])
def test_a_checkpoint_of_the_stock_trainer(arm: str, road: str, tmp_path: Path) -> None:
    """The moments come, and the clock is right, or it is said what to do."""
    first = begun(arm, upgrade=False).run(STOCK_AT)
    second = begun(arm, first)
    # Torch reads what the reader asks for: the stock trainer's files are read as partial ones.
    partial = {"partial": True} if "files" in road else {}
    with heard() as said:
        ROADS[road](first, second, tmp_path, **partial)
        assert_same_moments(second, first)
        second.run(STOCK_AT + 1)
    clock = second.phases.iteration == STOCK_AT + 1
    assert clock or any("iteration=" in each for each in said), said


@pytest.mark.parametrize("road", [by_dcp_files, by_flat_dcp_files])
def test_dcp_files_of_the_stock_trainer_read_whole_are_refused(road: Any, tmp_path: Path) -> None:
    """By torch, which names our key; nothing has been loaded."""
    first = begun("DEFAULTS", upgrade=False).run(STOCK_AT)
    second = begun("DEFAULTS", first)
    with pytest.raises(CheckpointException, match="opt3dgs"):
        road(first, second, tmp_path)
    loaded = {key: v for key, v in moments(second).items() if not key.endswith(".step")}
    assert all(float(value.abs().max()) == 0.0 for value in loaded.values())


@pytest.mark.parametrize("road", ROADS)
@pytest.mark.parametrize("arm", ["DEFAULTS", "paper"])
def test_a_checkpoint_of_ours_in_the_stock_trainer(arm: str, road: str, tmp_path: Path) -> None:
    """It steps on as torch's Adam does from these moments."""
    first = begun(arm).run(AT[arm])
    second, third = (begun(arm, first, upgrade=False) for _ in range(2))
    ROADS[road](first, second, tmp_path)
    assert_same_moments(second, first)
    plain = copy.deepcopy(first.optimizers.state_dict())
    stock = third.optimizers.state_dict()["param_groups"]
    state = {
        i: {key: value for key, value in each.items() if key in TORCHS}
        for i, each in plain["state"].items()
    }
    third.optimizers.load_state_dict({"state": state, "param_groups": stock})
    for training in (second, third):
        training.run(AT[arm] + 2)
    assert distance(second.values(), third.values()) == 0.0


@pytest.mark.parametrize("road", ["torch.save", "DCP", "DCP flat"])
@pytest.mark.parametrize("more", [MORE, 3])
def test_ours_to_stock_to_ours(road: str, more: int, tmp_path: Path) -> None:
    """The stock trainer has gone on meanwhile: its steps count, or it is said."""
    first = begun("DEFAULTS").run(40)
    between = begun("DEFAULTS", first, upgrade=False)
    ROADS[road](first, between, tmp_path / "a")
    between.run(40 + more)
    last = begun("DEFAULTS", between)
    with heard() as said:
        ROADS[road](between, last, tmp_path / "b")
        assert_same_moments(last, between)
        last.run(40 + more + 1)
    assert last.phases.iteration == 40 + more + 1 or any("iteration" in each for each in said)


def zero_rank(rank: int, port: int, folder: str, world: int) -> None:
    """The states of ZeroRedundancyOptimizer's ranks, consolidated on the first."""
    from torch import distributed
    from torch.distributed.optim import ZeroRedundancyOptimizer

    torch.set_num_threads(1)
    address = f"tcp://127.0.0.1:{port}"
    distributed.init_process_group("gloo", init_method=address, rank=rank, world_size=world)
    training = Training("DEFAULTS", upgrade=False, layout="single")
    groups = training.optimizers.param_groups
    options = {"lr": 1e-2, "eps": 1e-15}
    made = [{"params": g["params"], "name": g["name"], "lr": g["lr"]} for g in groups]
    sharded = ZeroRedundancyOptimizer(made, torch.optim.Adam, **options)  # pyright: ignore
    training.phases.upgrade(sharded.optim)
    training.optimizers, training.upgraded = sharded, True
    training.run(ZERO_AT)
    sharded.consolidate_state_dict(0)
    if rank == 0:
        state = sharded.state_dict()
        keys = sorted({key for each in state["state"].values() for key in each})
        torch.save({"state": state, "values": training.values(), "keys": keys}, f"{folder}/0.pt")
    distributed.barrier()
    distributed.destroy_process_group()


ZERO_AT = 60  # further than the clock may be off without a word


@pytest.mark.processes
@pytest.mark.parametrize("world", [1, 2])
def test_zeros_consolidation(world: int, tmp_path: Path) -> None:
    """One state of all ranks' parameters, which one process goes on with.

    ZeRO consolidates what is kept per parameter and leaves out the ranks' groups, in which the
    clock is: so it is said, and the trainer's own count sets it right.
    """
    arguments = (free_port(), str(tmp_path), world)
    torch.multiprocessing.spawn(zero_rank, args=arguments, nprocs=world)  # pyright: ignore
    saved = torch.load(tmp_path / "0.pt", weights_only=True)
    whole = begun("DEFAULTS").run(ZERO_AT)
    assert distance(saved["values"], whole.values()) == 0.0
    for counts in (False, True):
        second = begun("DEFAULTS", whole, counts=counts)
        with heard() as said:
            second.optimizers.load_state_dict(copy.deepcopy(saved["state"]))
            assert_same_moments(second, whole)
            second.run(ZERO_AT + 1)
        assert any("iteration=" in each for each in said) == (not counts), said
        assert counts == (second.phases.iteration == ZERO_AT + 1)


# -- formats of landed versions --------------------------------------------------------------------


# "everything" has parts today that format 2 did not know.
@pytest.mark.parametrize("arm", [arm for arm in landed_checkpoints.AT if arm != "everything"])
def test_checkpoints_of_format_2_are_gone_on_with(arm: str) -> None:
    """Written at ee0d4c4 by tests/support/landed_checkpoints.py; state under `param_groups`."""
    saved = torch.load(DATA / f"format_2_{arm}.pt", weights_only=True)
    training = begun(arm)
    with torch.no_grad():
        for name, value in saved["values"].items():
            training.splats[name].copy_(value)
    training.optimizers.load_state_dict(saved["optimizer"])
    assert training.phases.iteration == saved["iteration"]
    training.iteration = saved["iteration"]
    torch.set_rng_state(saved["random"])
    training.run()
    # Other versions of torch add in another order.
    assert distance(training.values(), saved["end"]) <= 1e-6


@pytest.mark.parametrize("kind", ["LQNAdam", "AWSGLD"])
def test_checkpoints_of_format_2_of_our_own_optimizers(kind: str) -> None:
    saved = torch.load(DATA / f"format_2_{kind}.pt", weights_only=True)
    x, optimizer = landed_checkpoints.own(kind)
    with torch.no_grad():
        x.copy_(saved["value"])
    optimizer.load_state_dict(saved["optimizer"])
    landed_checkpoints.step_own(x, optimizer, landed_checkpoints.MORE)
    assert torch.allclose(x.detach(), saved["end"], rtol=0, atol=1e-6)


# -- damage ----------------------------------------------------------------------------------------


def kept_keys(state: dict[int, dict[str, Any]]) -> list[tuple[int, str]]:
    """Where something is kept that is not torch's own: (parameter, key)."""
    return [(i, key) for i, each in state.items() for key in each if key not in TORCHS]


def of_other_columns(value: Tensor) -> Any:
    return torch.ones(*value.shape, 2) if value.dim() < 2 else value[:, :-1].clone()


def not_finite(value: Tensor) -> Tensor:
    damaged = value.clone()
    damaged[(0,) * damaged.dim()] = float("nan")  # a view would copy what is not contiguous
    return damaged


DAMAGE: dict[str, Callable[[Tensor], Any]] = {
    "a list": lambda value: value.tolist(),
    "None": lambda value: None,
    "a string": lambda value: "state",
    "a number": lambda value: 3.0,
    "0-d": lambda value: torch.zeros(()) if value.dim() else torch.zeros(2),
    "other columns": of_other_columns,
    "integers": lambda value: value.long(),
    "complex": lambda value: value.to(torch.complex64),
    "booleans": lambda value: value.bool(),
    "missing": lambda value: MISSING,
}
# What a healthy training can have: a stock trainer's edit of the moments, and a lost point.
OUT_OF_DATE: dict[str, Callable[[Tensor], Any]] = {
    "other rows": lambda value: torch.zeros(ROWS + 1, *value.shape[1:]),
    "no rows": lambda value: torch.zeros(0, *value.shape[1:]),
    "not finite": not_finite,
}
MISSING = object()
KEEPERS = ("Averaging", "Curvature", "Fading", "FreshMoments", "OutOfView", "DEFAULTS", "paper")


def flat(value: Any) -> Any:
    """A state_dict with tensors as lists, for comparison."""
    if isinstance(value, Tensor):
        return [tuple(value.shape), str(value.dtype), value.flatten().tolist()]
    if isinstance(value, dict):
        return {key: flat(item) for key, item in value.items()}
    return [flat(item) for item in value] if isinstance(value, (list, tuple)) else value


@pytest.fixture(scope="module")
def checkpoints() -> dict[str, Any]:
    """Of trainings that keep something: (state_dict, another training that is to load it)."""
    return {}


def checkpoint(checkpoints: dict[str, Any], arm: str) -> Any:
    if arm not in checkpoints:
        saved = begun(arm).run(AT[arm]).optimizers.state_dict()
        checkpoints[arm] = saved, begun(arm).run(3)
    return checkpoints[arm]


@pytest.mark.parametrize("how", DAMAGE)
@pytest.mark.parametrize("arm", ["Averaging", "Curvature"])
def test_damaged_state_of_a_part_is_refused_and_nothing_is_loaded(
    arm: str, how: str, checkpoints: dict[str, Any]
) -> None:
    saved, other = checkpoint(checkpoints, arm)
    keys = kept_keys(saved["state"])
    assert keys
    loaded = []
    for i, key in keys:
        damaged = copy.deepcopy(saved)
        value = DAMAGE[how](damaged["state"][i][key])
        if value is MISSING:
            del damaged["state"][i][key]
        else:
            damaged["state"][i][key] = value
        before = flat([other.optimizers.state_dict(), other.phases.state_dict()])
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                other.optimizers.load_state_dict(damaged)
        except ValueError as error:
            if "load_state_dict" not in str(error):
                loaded.append((i, key, str(error)))
        except Exception as error:
            loaded.append((i, key, repr(error)))
        else:
            loaded.append((i, key, "was loaded"))
        after = flat([other.optimizers.state_dict(), other.phases.state_dict()])
        if after != before:
            loaded.append((i, key, "has changed something"))
            checkpoints.pop(arm)
            saved, other = checkpoint(checkpoints, arm)
    assert loaded == []


@pytest.mark.parametrize("how", OUT_OF_DATE)
@pytest.mark.parametrize("arm", ["Averaging", "Curvature"])
def test_state_of_a_part_that_holds_no_more_begins_anew_and_it_is_said(
    arm: str, how: str, checkpoints: dict[str, Any]
) -> None:
    saved, _ = checkpoint(checkpoints, arm)
    part = kept_keys(saved["state"])[0][1].split(".")[0]
    for i, key in kept_keys(saved["state"]):
        changed = copy.deepcopy(saved)
        changed["state"][i][key] = OUT_OF_DATE[how](changed["state"][i][key])
        other = begun(arm).run(3)
        with pytest.warns(UserWarning, match=f"{part}.*anew"):
            other.optimizers.load_state_dict(changed)
        state = other.optimizers.state_dict()["state"]
        assert other.phases.iteration == AT[arm]
        if how == "not finite":  # this row alone, in all that the part keeps
            for each in [each for number, each in kept_keys(state) if number == i]:
                assert not state[i][each][0].any()
                assert torch.equal(state[i][each][1:], saved["state"][i][each][1:])
        else:
            assert {number for number, _ in kept_keys(state)} == {
                number for number, _ in kept_keys(saved["state"]) if number != i
            }
        other.iteration = AT[arm]
        other.run()
        assert all(bool(value.isfinite().all()) for value in other.values().values())


def test_all_that_is_kept_has_been_looked_at(checkpoints: dict[str, Any]) -> None:
    """The keys of the two arms above are those of all arms, but for parts' own names."""
    known = set()
    for arm in ("Averaging", "Curvature"):
        known |= {
            key.split(".")[-1] for _, key in kept_keys(checkpoint(checkpoints, arm)[0]["state"])
        }
    for arm in ("DEFAULTS", "DEFAULTS_ADC", "paper"):
        found = kept_keys(checkpoint(checkpoints, arm)[0]["state"])
        assert {key.split(".")[-1] for _, key in found} <= known


def test_rows_that_a_trainer_resizes_afterwards_still_load() -> None:
    """INRIA loads the optimizer before the points: all of the state has other rows, and fits."""
    x = Parameter(torch.zeros(6, 3))
    phases = PhaseScheduler(60, 10, [Averaging(), Curvature(names=GAUSSIAN)])
    adam = phases.upgrade(torch.optim.Adam([{"params": [x], "name": "xyz"}], lr=0.01))
    for _ in range(60):
        x.grad = torch.ones_like(x)
        phases.observe(0.1)
        adam.step()
    y = Parameter(torch.zeros(4, 3))
    again = PhaseScheduler(60, 10, [Averaging(), Curvature(names=GAUSSIAN)])
    other = again.upgrade(torch.optim.Adam([{"params": [y], "name": "xyz"}], lr=0.01))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        other.load_state_dict(adam.state_dict())
    assert again.iteration == 60
