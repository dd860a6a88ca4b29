"""The sampling study: its kernel is the package's arithmetic, its page says what was measured."""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import problems
import pytest
import torch
from studies.landscapes import laws, run, tables
from studies.landscapes.chains import Chains, Dynamics
from studies.landscapes.energies import (
    GRID,
    exact_rate,
    flattened_potential,
    kramers_rate,
    nine_masses,
    nine_minima,
    nine_modes,
    well_potential,
)
from studies.pages import filled

from opt3dgs_optim import AWSGLD, Course, EnergyHistogram, IsotropicNoise, Part

pytestmark = pytest.mark.processes

STEPS = 150
DYNAMICS = {
    "plain": Dynamics("nine", 1e-3, partitions=100, energy_range=(-7.667, 17.333)),
    "clamped": Dynamics("nine", 1e-3, partitions=50, energy_range=(-8, 9), clamp=(-0.5, 1.2)),
    "adam": Dynamics("nine", 0.02, "adam", 0.045, partitions=100, energy_range=(-7.667, 17.333)),
    "no histogram": Dynamics("nine", 1e-3, constant=0.3),
    "well": Dynamics("well", 1e-3, partitions=40, energy_range=(-0.5, 6.0), clamp=(-5, 5)),
}
HEIGHTS = np.array([1.0, 3.0, 5.0])


def options_of(name: str) -> Dynamics:
    return dataclasses.replace(DYNAMICS[name], stream_noise=0.32, boundary=2.5)


def starts(how: Dynamics) -> np.ndarray:
    """[3, D]; one of them at the edge of the domain, where steps are refused."""
    if how.landscape == "well":
        return np.array([[-1.0], [0.1], [1.3]])
    return np.array([[2.0, 2.0], [0.1, -0.2], [2.499, -2.499]])


class Constant(Part):
    """A constant multiplier of everything."""

    names = None

    def __init__(self, value: float) -> None:
        self.value = value

    def factor(self, group: Any, course: Course) -> float:
        return self.value


def real_chain(
    how: Dynamics, start: np.ndarray, height: float, draws: np.ndarray, stream: list[torch.Tensor]
) -> tuple[np.ndarray, Any, float]:
    """One chain of the package's own classes: its positions, its histogram, its sum of nu."""
    x = torch.nn.Parameter(torch.from_numpy(start[None].copy()))
    histogram = None
    if how.partitions:
        histogram = EnergyHistogram(
            how.partitions,
            how.energy_range,
            temperature=how.temperature,
            warmup=0,
            clamp=how.clamp,
        )
    noise = IsotropicNoise(temperature=how.temperature if how.std is None else None, std=how.std)
    optimizer = AWSGLD([x], how.lr, histogram=histogram, noise=noise, preconditioner=how.drift)
    if histogram is None:
        optimizer.follow(Course([*optimizer.course.parts, Constant(how.constant)]))
    dim, positions, nus = x.shape[1], [], 0.0
    normals = torch.from_numpy(draws)
    for draw in normals:
        positions.append(x.detach().numpy().copy()[0])
        leaf = x.detach().clone().requires_grad_()
        energy = (
            problems.nine_modes(leaf)
            if how.landscape == "nine"
            else problems.double_well(leaf, height)
        )
        (gradient,) = torch.autograd.grad(energy.sum(), leaf)
        x.grad = gradient + how.stream_noise * draw[1 : 1 + dim]
        if histogram is not None:
            histogram.observe(energy.detach()[0] + how.stream_noise * draw[0])
        stream.append(draw[None, 1 + dim :])
        optimizer.step()
        nus += how.constant if histogram is None else float(histogram.multiplier)
        if float(x.detach().abs().max()) > how.boundary:
            x.data = torch.from_numpy(positions[-1][None].copy())
    return np.array(positions), histogram, nus


@pytest.mark.parametrize("name", DYNAMICS)
def test_the_kernel_is_the_package(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """AWSGLD, EnergyHistogram and IsotropicNoise, chain by chain, with the same random numbers.

    1e-9: rounding (1e-16) grows where the landscape curves down, by up to exp(120 lr) per step
    for a few hundred steps at 1e-3; on a wrong formula the difference is of the size of a step.
    """
    how, stream = options_of(name), []
    monkeypatch.setattr(
        "opt3dgs_optim.parts.noise._normal_like", lambda tensor, generator: stream.pop()
    )
    chains = Chains(how, starts(how), seed=5, heights=HEIGHTS)
    draws = Chains(how, starts(how), seed=5).draws(STEPS)
    found: list[np.ndarray] = []
    chains.run(STEPS, lambda samples: found.append(samples.positions))
    (positions,) = found
    for c, start in enumerate(starts(how)):
        expected, histogram, nus = real_chain(how, start, HEIGHTS[c], draws[:, c], stream)
        np.testing.assert_allclose(positions[:, c], expected, rtol=0, atol=1e-9)
        assert chains.nu_sum[c] == pytest.approx(nus, abs=1e-7)
        if how.partitions:
            np.testing.assert_allclose(chains.theta[c], histogram.weights, rtol=0, atol=1e-12)
            assert nus != STEPS  # nu was at work
    moved = np.abs(np.diff(positions[:, 2], axis=0)).max(1) > 0
    assert moved.any()
    if how.landscape == "nine":
        assert not moved.all()  # a step out of the domain was refused


def test_blocks_do_not_matter() -> None:
    """Two runs of 700 are one of 1,400: moments, weights and lambda's step go on."""
    ends = []
    for parts in ([1400], [1000, 400]):
        chains = Chains(options_of("adam"), starts(DYNAMICS["adam"]), seed=1)
        for steps in parts:
            chains.run(steps)
        ends.append((chains.x, chains.theta, chains.mean_nu))
    for one, other in zip(*ends, strict=True):
        np.testing.assert_array_equal(one, other)


def test_energies_are_those_of_the_problems() -> None:
    x = torch.linspace(-2.5, 2.5, 31, dtype=torch.float64)
    points = torch.cartesian_prod(x, x)
    assert torch.allclose(nine_modes(points), problems.nine_modes(points), rtol=1e-14, atol=1e-13)
    assert torch.allclose(well_potential(2.0), problems.double_well(GRID[:, None], 2.0))
    gradient = problems.gradient(problems.nine_modes, nine_minima())
    assert float(gradient.abs().max()) < 1e-12
    assert float(nine_masses().sum()) == pytest.approx(1.0)
    assert float(nine_masses()[4]) == pytest.approx(float(nine_masses(400)[4]), rel=1e-2)


def test_exact_rates_have_kramers_limit() -> None:
    """Kramers' error is of the order of T / h."""
    for height in (10.0, 40.0):
        assert kramers_rate(height) == pytest.approx(problems.kramers_rate(height, 1.0))
        ratio = exact_rate(well_potential(height)) / kramers_rate(height)
        assert 1 - 0.6 / height < ratio < 1


def test_a_flattening_of_nothing_is_the_well() -> None:
    """Zeta 0 leaves the well alone; zeta 0.75 lowers its barrier."""
    potential, nu = flattened_potential(3.0, 25, 0.0, 12.5, 0.0, (-5.0, 5.0))
    assert nu == pytest.approx(1.0)
    inner = GRID.abs() < 2  # beyond, the energy is above the range
    assert torch.allclose(potential[inner], well_potential(3.0)[inner], atol=1e-9)
    flat, _ = flattened_potential(3.0, 25, 0.0, 12.5, 0.75, (-5.0, 5.0))
    assert exact_rate(flat) > exact_rate(well_potential(3.0))


def test_gaussian_law() -> None:
    """The plain drift's variance, with the O(lr) bias of the discretisation."""
    found = laws.gaussian_law(
        "sgld", chains=2000, seeds=1, rates=[0.25], betas=[0.9, 0.999], progress=lambda n: None
    )
    (row,) = found["rows"]
    assert row["expected"] == pytest.approx(2 * found["target"])  # 1 / (1 - lr k / 2)
    # 20 x 2,000 draws, little correlated: 0.8 % standard error
    assert row["variance"][0] == pytest.approx(row["expected"], rel=0.03)


def test_bad_input_is_named() -> None:
    chains = Chains(DYNAMICS["plain"], starts(DYNAMICS["plain"]), seed=0)
    with pytest.raises(ValueError, match="every=7, but a divisor of 1000"):
        chains.run(10, every=7)
    chains = Chains(Dynamics("well", 1.0), np.full((2, 1), 50.0), seed=0)
    with pytest.raises(FloatingPointError, match="is not finite"):
        chains.run(20)


@pytest.fixture
def _threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("_threads")
def test_quick_run_interrupted_and_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--quick", "-o", str(tmp_path)]

    def interrupted(*args: Any, **options: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(laws, "escape_rates", interrupted)
        assert run.main(arguments) == 130
    before = {path: path.read_bytes() for path in tmp_path.glob("*.json")}
    assert len(before) == len(run.experiments(True)) - 2
    assert run.main(arguments) == 0
    assert all(path.read_bytes() == content for path, content in before.items())
    names = {path.name for path in tmp_path.iterdir()}
    assert {"nine.png", "kramers.png", "tables.md"} <= names
    assert not [name for name in names if name.endswith(".part")]
    assert len(run.load(tmp_path)) == len(run.experiments(True))
    capsys.readouterr()


def test_quick_results_stay_out_of_the_docs(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        run.main(["--quick"])
    assert "--quick needs -o" in capsys.readouterr().err


# -- the committed results -------------------------------------------------------------------------


def seeds_of(name: str) -> list[dict[str, Any]]:
    return run.load(run.RESULTS)[f"nine-{name}"]["result"]["seeds"]


def mean(name: str, figure: str) -> float:
    return statistics.fmean(seed[figure] for seed in seeds_of(name))


def test_the_page_has_the_committed_figures() -> None:
    results = run.load(run.RESULTS)
    settings = {name: found[2] for name, found in run.experiments(False).items()}
    assert {name: entry["settings"] for name, entry in results.items()} == settings
    results = {name: results[name] for name in settings}  # the tables' order
    sections = tables.sections(results)
    page = run.PAGE.read_text(encoding="utf-8")
    assert filled(page, sections, run.MARK) == page


def test_what_the_page_says_of_the_nine_modes() -> None:
    """Its sentences, as inequalities on the committed figures."""
    assert mean("awsgld", "modes") > 8.95
    assert mean("awsgld", "kl") < 0.011
    assert mean("awsgld", "median_iterations") < 71_000
    assert mean("sgld", "modes") < 6
    assert mean("cyclic", "modes") < 8
    assert mean("adam", "modes") < 1.1
    for name in ("awsgld", "awsgld-clamped"):  # the control is at least as good
        assert mean("constant-0.3", "modes") >= mean(name, "modes")
        assert mean("constant-0.3", "median_iterations") < mean(name, "median_iterations")
        assert mean("constant-0.3", "kl") < mean(name, "kl")
    assert mean("adam-positive", "modes") < mean("adam-clamped", "modes") < 8


def test_filling_a_page_twice_is_filling_it_once() -> None:
    page = "before\n<!-- one -->\n<!-- end -->\nbetween\n<!-- two -->\nold\n<!-- end -->\n"
    texts = {"one": "1", "two": "2"}
    made = filled(page, texts, run.MARK)
    assert made == page.replace("one -->", "one -->\n1").replace("old", "2")
    assert filled(made, texts, run.MARK) == made
    with pytest.raises(ValueError, match="0 places for 'three'"):
        filled(page, texts | {"three": "3"}, run.MARK)
    with pytest.raises(ValueError, match="marker <!-- two --> is unknown; there are one"):
        filled(page, {"one": "1"}, run.MARK)


def test_what_the_page_says_of_the_rates() -> None:
    """SGLD's rate is the exact one, AWSGLD's grows with the barrier and follows its theory."""
    results = run.load(run.RESULTS)
    for row in results["escape-sgld"]["result"]["rows"]:
        # A count of n has a relative deviation of 1 / sqrt(n); 5 % for the step's own bias
        bound = 4 / row["crossings"] ** 0.5 + 0.05
        assert statistics.fmean(row["rate"]) == pytest.approx(row["exact"], rel=bound)
    for row in results["escape-awsgld"]["result"]["rows"]:
        rate = statistics.fmean(row["rate"])
        assert rate == pytest.approx(row["flattened"], rel=0.1 if row["height"] >= 5 else 0.25)
        if row["height"] >= 3:
            assert rate > 2 * row["exact"]
            assert rate == pytest.approx(row["constant"], rel=0.15)
