"""gsplat 1.6's scene tells which rows moved: the curvature pairs of the others stay in use."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from opt3dgs_optim.rows import reset_points

# gsplat edits every tensor of the state by the same rows, and new rows are zero: after these the
# pairs belong to their points.
FOLLOWED = ("on_duplicate", "on_split", "on_remove", "on_sample_add", "on_permute")


def follow_scene(scene: Any, optimizers: Any) -> None:
    """Let a scene of gsplat 1.6 tell which rows its density control moved.

    Without it every edit drops all curvature pairs; with it only those of moved points: the scene's
    `on_*` methods, wrapped on this instance, call `reset_points`. Relocation moves dead rows onto
    live ones but leaves their state: those are the ones that are reset.

    Args:
        scene: gsplat's.
        optimizers: the upgraded ones, as for `reset_points`; a dict is read anew at each edit.

    Raises:
        TypeError: `scene` has no such methods (gsplat before 1.6: pass nothing, edits are noticed).
    """
    missing = [name for name in (*FOLLOWED, "on_relocate") if not hasattr(scene, name)]
    if missing:
        raise TypeError(
            f"follow_scene: a {type(scene).__name__} has no {missing[0]}; a scene "
            "of gsplat 1.6 or later is needed (earlier ones need no call, edits are noticed)"
        )
    nothing = torch.zeros(0, dtype=torch.long)
    for name in FOLLOWED:
        _after(scene, name, lambda *_: reset_points(optimizers, nothing))
    _after(scene, "on_relocate", lambda dead, *_: reset_points(optimizers, dead))


def _after(scene: Any, name: str, then: Callable[..., None]) -> None:
    original = getattr(scene, name)

    def hook(*args: Any, **kwargs: Any) -> None:
        original(*args, **kwargs)
        then(*args, *kwargs.values())

    setattr(scene, name, hook)
