"""Adam's moments at 16 bits a number: what codes mean, and what trainers do to them."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from gaussians import adam_of, adams_of, parameters, through_a_file
from masked_adams import SelectiveAdam
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Adam

from opt3dgs_optim import PhaseScheduler
from opt3dgs_optim.moments import CODES, NEAREST, chances, decoded, encode
from opt3dgs_optim.step import mixed

SHAPES = {
    "means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh0": (1, 3), "shN": (15, 3),
}  # fmt: skip
MOMENTS = ("exp_avg", "exp_avg_sq")
BYTES = 236  # a half of the 472 of float32, at degree 3
FIRST, SECOND = 2.0**-8, 2.0**-9  # half of the way between two codes, of a number


def coded(first: Tensor, second: Tensor, key: int | None, at: int = 0) -> tuple[Tensor, Tensor]:
    codes = torch.empty_like(first, dtype=CODES), torch.empty_like(first, dtype=CODES)
    encode(first, second, *codes, NEAREST if key is None else chances(first, key, at))
    return codes


def wide(count: int) -> tuple[Tensor, Tensor]:
    """Moments of every size that float32 has."""
    draw = torch.Generator().manual_seed(0)
    size = torch.logspace(-36, 36, count)
    sign = torch.randn(count, generator=draw).sign()
    first, second = 0.5 + torch.rand(2, count, generator=draw)
    return sign * first * size, second * size


def trained(count: int = 200, moments: Any = 16, total: int = 60) -> tuple[Any, Any]:
    draw = torch.Generator().manual_seed(0)
    adams = {
        name: Adam([Parameter(torch.randn(count, *shape, generator=draw))], lr=1e-2, eps=1e-15)
        for name, shape in SHAPES.items()
    }
    phases = PhaseScheduler(total, moments=moments)
    return phases.upgrade(adams), phases


def param_of(adam: Adam) -> Parameter:
    return adam.param_groups[0]["params"][0]


def iterate(adams: dict[str, Adam], first: int, last: int) -> None:
    for i in range(first, last):
        draw = torch.Generator().manual_seed(i)
        for adam in adams.values():
            param = param_of(adam)
            noise = torch.randn(param.shape, generator=draw)
            param.grad = 0.1 * noise + 0.1 * param.detach()
            adam.step()


def values(adams: dict[str, Adam]) -> list[Tensor]:
    return [param_of(adam).detach().clone() for adam in adams.values()]


def same(one: list[Tensor], other: list[Tensor]) -> bool:
    return all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


# -- codes -----------------------------------------------------------------------------------------


def test_a_code_is_as_near_as_it_says_over_float32s_whole_range() -> None:
    first, second = wide(20_000)
    found = decoded(*coded(first, second, None))
    assert ((found[0] - first).abs() <= FIRST * first.abs()).all()
    assert ((found[1] - second).abs() <= SECOND * second).all()


@pytest.mark.parametrize(
    ("key", "at"), [(0, 0), (7, 2**31 - 3), (2**31, 2**32 - 3), (2**32 - 1, 5)]
)
def test_chances_are_the_hash_of_the_place_and_the_step(key: int, at: int) -> None:
    """A checkpoint resumed by another version, or on another device, rounds alike."""
    bits = torch.randint(1, 2**31 - 2**24, (2, 500), generator=torch.Generator().manual_seed(0))
    numbers = bits.to(torch.int32).view(torch.float32)
    found = coded(numbers[0], numbers[1], key, at)
    for i in range(500):
        chance = mixed(((at + i) % 2**32) ^ key)
        first, second = (int(bits[which, i]) for which in (0, 1))
        assert int(found[0][i]) == (first + (chance >> 16)) >> 16
        assert int(found[1][i]) % 2**16 == (second + chance % 2**15) >> 15


def test_zero_is_zero_and_a_row_without_second_moment_has_no_first() -> None:
    zeros = torch.zeros(3, dtype=CODES)
    assert all(torch.equal(each, torch.zeros(3)) for each in decoded(zeros, zeros))
    codes = coded(torch.zeros(3), torch.zeros(3), key=12345)
    assert all(torch.equal(each, zeros) for each in codes)
    ones = coded(torch.ones(3), torch.ones(3), None)
    assert torch.equal(decoded(ones[0], zeros)[0], torch.zeros(3))


def test_codes_are_right_in_the_mean() -> None:
    first, second = wide(2_000)
    sums = torch.zeros(2, 2_000, dtype=torch.float64)
    for step in range(1, 501):
        sums += torch.stack(decoded(*coded(first, second, mixed(step))))
    for total, right, most in zip(sums, (first, second), (FIRST, SECOND), strict=True):
        away = total / 500 / right - 1.0
        # The spread of the mean of 500 coins, each up to a code wide, and of 2,000 such means.
        assert away.abs().max() < 2 * most * 0.5 / 500**0.5 * 5
        assert abs(away.mean().item()) < 2 * most * 0.5 / (500 * 2_000) ** 0.5 * 5


# -- trainings -------------------------------------------------------------------------------------


def test_half_of_the_bytes() -> None:
    sizes = {}
    for moments in (16, 32):
        adams, _ = trained(1_000, moments)
        iterate(adams, 0, 2)
        states = [adam.state[param_of(adam)] for adam in adams.values()]
        assert all(set(state) == {"step", *MOMENTS} for state in states)
        sizes[moments] = sum(s[k].numel() * s[k].element_size() for s in states for k in MOMENTS)
    assert sizes == {16: 1_000 * BYTES, 32: 2_000 * BYTES}


def kept(adams: dict[str, Adam], *keys: str) -> int:
    """Bytes of what is kept under these names."""
    states = [adam.state[param_of(adam)] for adam in adams.values()]
    return sum(s[k].numel() * s[k].element_size() for s in states for k in keys if k in s)


MEAN = ("averaging.mean", "averaging.residue", "averaging.began")


@pytest.mark.parametrize(("moments", "size"), [(32, 260), (16, 148)])
def test_what_the_mean_takes(moments: int, size: int) -> None:
    """With six numbers a row, which say when each mean began."""
    adams, _ = trained(100, moments, total=300)
    iterate(adams, 0, 292)
    assert kept(adams, *MEAN) == 100 * size
    assert "averaging.mean" in adams["means"].state[param_of(adams["means"])]


@pytest.mark.parametrize("moments", [32, 16])
def test_a_mean_in_the_other_form_begins_anew(
    moments: Any, caplog: pytest.LogCaptureFixture
) -> None:
    """A checkpoint of the last thirtieth, and as many bits as it had not."""
    adams, _ = trained(20, moments, total=300)
    iterate(adams, 0, 294)
    again, _ = trained(20, 48 - moments, total=300)
    caplog.set_level("INFO", "opt3dgs_optim")
    for adam, other in zip(adams.values(), again.values(), strict=True):
        param_of(other).data.copy_(param_of(adam))
        other.load_state_dict(adam.state_dict())
    assert not kept(again, *MEAN)
    said = f"the mean of the last iterates begins anew, at {48 - moments} bits"
    assert sum(said in message for message in caplog.messages) == 1
    iterate(again, 294, 300)
    began = [adam.state[param_of(adam)]["averaging.began"] for adam in again.values()]
    assert all((each == 295).all() for each in began)


def test_a_mean_of_other_numbers_than_the_parameter_is_refused() -> None:
    adams, _ = trained(20, 16, total=300)
    iterate(adams, 0, 294)
    saved = adams["sh0"].state_dict()
    saved["state"][0]["averaging.residue"] = saved["state"][0]["averaging.residue"][..., :2]
    with pytest.raises(ValueError, match="the same rows are needed in all"):
        adams["sh0"].load_state_dict(saved)


@pytest.mark.parametrize("moments", [32, 16])
def test_noise_of_the_trainer_stays_out_of_the_mean_of_positions(moments: Any) -> None:
    """As that of 3DGS-MCMC, after each step."""
    adams, _ = trained(1_000, moments, total=300)
    means, draw = param_of(adams["means"]), torch.Generator().manual_seed(1)
    iterate(adams, 0, 285)
    for i in range(285, 300):
        means.data = 100.0 + 10.0 * torch.randn(means.shape, generator=draw)
        iterate(adams, i, i + 1)
    assert means.detach().std() == pytest.approx(10.0 / 10**0.5, rel=0.05)
    assert kept(adams, "averaging.residue") == (0 if moments == 32 else 1_000 * 112)


@pytest.mark.parametrize(("at", "total"), [(33, 60), (293, 300), (298, 300)])
@pytest.mark.parametrize("order", ["gsplat", "INRIA"])
def test_a_resume_is_bit_for_bit(order: str, at: int, total: int) -> None:
    """Also in the last thirtieth, and where the mean is in the parameters' place."""
    adams, _ = trained(total=total)
    iterate(adams, 0, at)
    saved = through_a_file([(param_of(a).detach(), a.state_dict()) for a in adams.values()])
    iterate(adams, at, total)
    if order == "gsplat":
        again, _ = trained(total=total)
    else:
        again = {k: Adam([Parameter(torch.zeros(200, *s))], lr=1e-2) for k, s in SHAPES.items()}
    for adam, (values_, state) in zip(again.values(), saved, strict=True):
        param_of(adam).data.copy_(values_)
        adam.load_state_dict(state)
    if order == "INRIA":
        PhaseScheduler(total, moments=16).upgrade(again)
    iterate(again, at, total)
    assert same(values(adams), values(again))


def test_stocks_moments_are_taken_and_given_back(caplog: pytest.LogCaptureFixture) -> None:
    stock = {k: Adam([Parameter(torch.ones(200, *s))], lr=1e-2) for k, s in SHAPES.items()}
    iterate(stock, 0, 10)
    before = {k: a.state[param_of(a)]["exp_avg_sq"].clone() for k, a in stock.items()}
    with caplog.at_level("INFO", "opt3dgs_optim"):
        PhaseScheduler(60, parts=[], moments=16).upgrade(stock)
    assert sum("moments that were there are now at 16 bits" in m for m in caplog.messages) == 1
    for name, adam in stock.items():
        state = adam.state[param_of(adam)]
        assert state["exp_avg"].dtype == state["exp_avg_sq"].dtype == CODES
        found = decoded(state["exp_avg"], state["exp_avg_sq"])[1]
        torch.testing.assert_close(found, before[name], rtol=SECOND, atol=0.0)
    PhaseScheduler(60, parts=[]).upgrade(stock)
    for name, adam in stock.items():
        state = adam.state[param_of(adam)]
        torch.testing.assert_close(state["exp_avg_sq"], before[name], rtol=SECOND, atol=0.0)
    iterate(stock, 10, 12)


# -- edits of rows ---------------------------------------------------------------------------------


def edit(adam: Adam, rows: Any) -> None:
    old, group = param_of(adam), adam.param_groups[0]
    state = adam.state.pop(old)
    for key in MOMENTS:
        state[key] = rows(state[key], False)
    group["params"] = [Parameter(rows(old.detach(), True))]
    adam.state[group["params"][0]] = state


def appended(x: Tensor, is_param: bool) -> Tensor:
    """As gsplat and INRIA's family do: zeros of float32."""
    return torch.cat([x, x[:5] if is_param else torch.zeros(5, *x.shape[1:])])


@pytest.mark.parametrize("rows", [appended, lambda x, _: x[3:], lambda x, _: torch.cat([x, x[:4]])])
def test_rows_are_edited_by_trainers_that_know_nothing_of_it(rows: Any) -> None:
    adams, _ = trained()
    iterate(adams, 0, 10)
    states = {k: dict(a.state[param_of(a)]) for k, a in adams.items()}
    for adam in adams.values():
        edit(adam, rows)
    before = {k: rows(states[k]["exp_avg_sq"], False).to(CODES) for k in adams}
    for name, adam in adams.items():
        param = param_of(adam)
        param.grad = torch.zeros_like(param)
        start = param.detach().clone()
        adam.step()
        state = adam.state[param]
        assert state["exp_avg"].dtype == state["exp_avg_sq"].dtype == CODES
        zero = before[name] == 0
        assert torch.equal(state["exp_avg_sq"] == 0, zero)
        assert torch.equal(param[zero], start[zero])  # no history, no gradient: no step
        kept = decoded(before[name], before[name])[1][~zero]
        now = decoded(state["exp_avg"], state["exp_avg_sq"])[1][~zero]
        assert (now / kept - 0.999).abs().max() <= 2 * SECOND  # a code up or down


# -- averages that change slowly -------------------------------------------------------------------


@pytest.mark.parametrize("moments", [32, 16])
def test_noise_does_not_drift(moments: Any) -> None:
    """Second moments stay at the mean square of the gradients; what is stepped goes nowhere."""
    x = Parameter(torch.zeros(2_000, 4))
    adam = Adam([{"params": [x], "name": "quats"}], lr=1e-3, eps=1e-15)
    PhaseScheduler(4_000, parts=[], moments=moments).upgrade(adam)
    draw = torch.Generator().manual_seed(0)
    means = []
    for i in range(4_000):
        x.grad = 1e-5 * torch.randn(x.shape, generator=draw)
        adam.step()
        if i >= 3_000 and i % 100 == 0:
            pair = adam.state[x]["exp_avg"], adam.state[x]["exp_avg_sq"]
            means.append((pair[1] if moments == 32 else decoded(*pair)[1]).mean().item())
    expected = 1e-10 * (1 - 0.999**3_500)
    assert sum(means) / len(means) == pytest.approx(expected, rel=5e-3)
    spread = 1e-3 * 4_000**0.5  # of a walk of steps with a mean square of one rate
    assert abs(x.mean().item()) < 5 * spread / 8_000**0.5
    assert x.std().item() == pytest.approx(spread, rel=0.05)


# -- what is refused -------------------------------------------------------------------------------


@pytest.mark.parametrize("bits", [8, 0, 64, "16", 16.0, True])
def test_other_numbers_of_bits_are_refused(bits: Any) -> None:
    with pytest.raises(ValueError, match=r"^\w+: moments=.*, but 32 or 16 is needed"):
        PhaseScheduler(10, moments=bits)


def test_steps_of_other_classes_and_float64_are_refused() -> None:
    masked = SelectiveAdam([{"params": [Parameter(torch.ones(2, 3))], "name": "means"}])
    with pytest.raises(ValueError, match="moments=16, but SelectiveAdam makes its own step"):
        PhaseScheduler(10, moments=16).upgrade(masked)
    assert type(masked) is SelectiveAdam
    double = Adam([{"params": [Parameter(torch.ones(2, 3).double())], "name": "means"}])
    with pytest.raises(ValueError, match=r"moments=16 with \['torch.float64'\]; use float32"):
        PhaseScheduler(10, moments=16).upgrade(double)


def test_groups_that_are_no_gaussians_are_refused() -> None:
    """Poses and networks: a group beside them, an optimizer beside theirs, one that comes later."""
    pose = {"params": [Parameter(torch.ones(4, 9))], "name": "pose"}
    beside = adam_of(parameters(4))
    beside.add_param_group(dict(pose))
    with pytest.raises(ValueError, match="the group 'pose' beside the Gaussians"):
        PhaseScheduler(60, moments=16).upgrade(beside)
    assert type(beside) is Adam
    both = {**adams_of(parameters(4)), "camera_opt": Adam(pose["params"])}
    with pytest.raises(ValueError, match="holds no Gaussians; upgrade those of the Gaussians"):
        PhaseScheduler(60, moments=16).upgrade(both)
    optimizer = PhaseScheduler(60, moments=16).upgrade(adam_of(parameters(4)))
    with pytest.raises(ValueError, match="the group 'pose' beside the Gaussians"):
        optimizer.add_param_group(dict(pose))
    assert len(optimizer.param_groups) == 6
