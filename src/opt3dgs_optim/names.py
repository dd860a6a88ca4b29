"""Which parameter group is which Gaussian parameter, in the names trainers use."""

from collections.abc import Iterable, Mapping
from typing import Any

# gsplat | INRIA and 3dgs-mcmc | nerfstudio
GAUSSIAN_NAMES: Mapping[str, tuple[str, ...]] = {
    "means": ("means", "xyz"),
    "scales": ("scales", "scaling"),
    "quats": ("quats", "rotation"),
    "opacities": ("opacities", "opacity"),
    "sh0": ("sh0", "f_dc", "features_dc", "colors"),
    "shN": ("shN", "f_rest", "features_rest", "features"),
}
GAUSSIAN = tuple(GAUSSIAN_NAMES)
SLOT = "gaussian"  # of a parameter group: gsplat's name of what it holds, written by `upgrade`
_CANONICAL = {alias: name for name, aliases in GAUSSIAN_NAMES.items() for alias in aliases}


def canonical_name(name: Any) -> str | None:
    """gsplat's name of a Gaussian parameter group, or None for any other group."""
    return _CANONICAL.get(name) if isinstance(name, str) else None


def group_name(index: int, group: Mapping[str, Any]) -> str:
    """How a group is called in messages."""
    return str(group.get("name") or group.get(SLOT) or f"group {index}")


def block(name: str, lines: Iterable[str]) -> str:
    """What an object with parts says of itself: `name(`, the lines, indented, and `)`."""
    return "\n".join([f"{name}(", *(f"  {line}" for line in lines), ")"])


def check_names(call: str, names: Any) -> tuple[str, ...]:
    """gsplat's names of these Gaussian parameters; ValueError for another name, or none at all."""
    given = names if isinstance(names, (tuple, list)) else ()
    found = tuple(known for name in given if (known := canonical_name(name)) is not None)
    if not found or len(found) < len(given):
        raise ValueError(
            f"{call}: names={names!r}, but a tuple of Gaussian parameters' names is needed: "
            f"{', '.join(GAUSSIAN_NAMES)}"
        )
    return found
