"""The names of the trainers' parameter groups, as their sources write them."""

from __future__ import annotations

import pytest
import torch
from torch.nn import Parameter
from torch.optim import Adam

from opt3dgs_optim import PhaseScheduler
from opt3dgs_optim.names import GAUSSIAN, GAUSSIAN_NAMES, SLOT, canonical_name, split_name

TRAINERS = {  # in the order of GAUSSIAN
    "gsplat": "means scales quats opacities sh0 shN",
    "INRIA": "xyz scaling rotation opacity f_dc f_rest",
    "nerfstudio": "means scales quats opacities features_dc features_rest",
    "3DGRUT": "positions scale rotation density features_albedo features_specular",
    "fVDB": "means log_scales quats logit_opacities sh0 shN",
    "gaussian-splatting-lightning": "means scales rotations opacities shs_dc shs_rest",
    "Faster-GS": "means scales rotations opacities sh_coefficients_0 sh_coefficients_rest",
    "drivestudio": "xyz scaling rotation opacity sh_dc sh_rest",
}
WIDTHS = (3, 3, 4, 1, 3, 45)


def adam_with(names: list[str], rows: int = 6) -> Adam:
    widths = (WIDTHS * len(names))[: len(names)]
    groups = [
        {"params": [Parameter(torch.ones(rows, width))], "lr": 0.01, "name": name}
        for name, width in zip(names, widths, strict=True)
    ]
    return Adam(groups, lr=0.0, eps=1e-15)


@pytest.mark.parametrize("trainer", TRAINERS)
def test_all_six_are_known(trainer: str) -> None:
    names = TRAINERS[trainer].split()
    assert tuple(canonical_name(name) for name in names) == GAUSSIAN
    optimizer = PhaseScheduler(100).upgrade(adam_with(names))
    assert tuple(group.get(SLOT) for group in optimizer.param_groups) == GAUSSIAN


def test_no_name_means_two_things() -> None:
    every = [alias for aliases in GAUSSIAN_NAMES.values() for alias in aliases]
    assert len(every) == len({*every})


@pytest.mark.parametrize("name", ["features", "exposure", "pose", "anchor", "", None, 3, "#", "x#"])
def test_what_is_no_gaussian_parameter(name: object) -> None:
    """`features` is a network's input in 3DGRUT and in gsplat's --app_opt."""
    assert canonical_name(name) is None


@pytest.mark.parametrize(
    ("name", "split"),
    [
        ("xyz", ("", "means")),
        ("Background#xyz", ("Background", "means")),
        ("Rigid#Nodes#sh_rest", ("Rigid#Nodes", "shN")),
        ("#opacity", ("", "opacities")),
    ],
)
def test_the_set_before_the_mark(name: str, split: tuple[str, str | None]) -> None:
    assert split_name(name) == split


def test_several_sets_in_one_optimizer() -> None:
    """drivestudio: each set is trained as it would be alone, in an optimizer of its own."""
    names = TRAINERS["drivestudio"].split()
    sets = {"Background": 8, "RigidNodes": 5}

    def train(optimizers: list[Adam]) -> None:
        schedulers = [PhaseScheduler(60) for _ in optimizers]
        for phases, optimizer in zip(schedulers, optimizers, strict=True):
            phases.upgrade(optimizer)
        for iteration in range(60):
            for optimizer in optimizers:
                for index, group in enumerate(optimizer.param_groups):
                    (param,) = group["params"]
                    torch.manual_seed(iteration + 1000 * (index % 6) + len(param))
                    param.grad = torch.randn(param.shape)
                    param.grad[iteration % len(param)] = 0.0
            for phases, optimizer in zip(schedulers, optimizers, strict=True):
                phases.observe(0.1)
                optimizer.step()

    alone = [adam_with(names, rows) for rows in sets.values()]
    train(alone)
    prefixed = [adam_with([f"{name}#{n}" for n in names], rows) for name, rows in sets.items()]
    together = Adam([g for optimizer in prefixed for g in optimizer.param_groups], eps=1e-15)
    train([together])
    ends = [group["params"][0] for optimizer in alone for group in optimizer.param_groups]
    for group, end in zip(together.param_groups, ends, strict=True):
        assert torch.equal(group["params"][0], end), group["name"]


OTHERS = {  # groups beside the six that are left alone, as the trainers name them
    "3DGRUT": "features",
    "gsplat": "features app_module pose_opt",
    "Scaffold-GS": "offset anchor_feat mlp_opacity embedding_appearance",
    "INRIA": "exposure",
    "drivestudio": "Background#features CamPose#all_camera",
    "nerfstudio": "camera_opt bilateral_grid",
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("trainer", OTHERS)
def test_known_groups_of_other_things_are_left_alone_in_silence(trainer: str) -> None:
    """Even where there are as many photos as Gaussians."""
    others = OTHERS[trainer].split()
    optimizer = PhaseScheduler(100).upgrade(adam_with([*TRAINERS["INRIA"].split(), *others]))
    assert [group.get(SLOT) for group in optimizer.param_groups[6:]] == [None] * len(others)


# The second line: a known other group's name, or a word of it, is only a part of these.
MAYBE = ["sizes", "log_sizes", "anchor", "Background#sizes"]
MAYBE += ["features_dc_low", "offset_means", "CamPose#sizes", "exposed_opacities", "gridded_scales"]


@pytest.mark.parametrize("name", MAYBE)
def test_groups_that_may_be_gaussians_are_warned_of(name: str) -> None:
    with pytest.warns(UserWarning, match=f"{name} stay as they are"):
        PhaseScheduler(100).upgrade(adam_with([*TRAINERS["INRIA"].split(), name]))
