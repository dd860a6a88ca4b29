"""What a checkpoint holds of an adaptive run, and its checks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from opt3dgs_optim._checkpoint import check_floats, check_keys, check_whole

PARTS = ("multiplier", "curvature", "noise", "view_centering", "epoch_pairs")
NO_EVIDENCE: dict[str, Any] = {
    "switched_off": {},
    "constant": None,
    "windows": [],
    "probes": 0,
    "pairs": [0.0] * 4,
    "view": None,
    "views": 0,
    "edited": False,
}


def check_loadable(call: str, state: Mapping[str, Any], adaptive: bool) -> None:
    """ValueError unless a scheduler's `state` can be loaded into one with or without `adaptive`."""
    saved = state.get("adaptive")
    if saved is None:
        return
    name = f"{call}: adaptive"
    check_keys(name, saved, tuple(NO_EVIDENCE))
    off = saved["switched_off"]
    check_keys(f"{name}: switched_off", off, ())
    if set(off) - set(PARTS):
        raise ValueError(f"{name}: parts {sorted(off)}, but there are {', '.join(PARTS)}")
    if off and not adaptive:
        raise ValueError(
            f"{call}: of a run that has switched off {', '.join(off)}, but this scheduler is not "
            "adaptive; adaptive=True is needed"
        )
    check_whole(name, "probes", saved["probes"])
    check_floats(name, "pairs", saved["pairs"], 4)
    if not isinstance(saved["windows"], list):
        raise ValueError(f"{name}: windows={saved['windows']!r}, but a list is needed")
    for each in saved["windows"]:
        check_floats(name, "windows", each, 3)
    if "multiplier" in off:
        check_floats(name, "constant", [saved["constant"]], 1)
