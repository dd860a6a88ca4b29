"""Names that trainers and torch use: of Gaussian parameters in groups, and of Adam's state."""

import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from torch import Tensor

# gsplat's name, then those of INRIA and 3dgs-mcmc and of the trainers in the comments; no name may
# stand twice. The `features` of 3DGRUT and of gsplat's --app_opt are none of them: they are inputs
# of a network.
GAUSSIAN_NAMES: Mapping[str, tuple[str, ...]] = {
    "means": ("means", "xyz", "positions", "means3d"),  # 3DGRUT, gsplat before 1.0
    "scales": ("scales", "scaling", "scale", "log_scales"),  # 3DGRUT, fVDB
    "quats": ("quats", "rotation", "rotations"),  # gaussian-splatting-lightning, Faster-GS
    "opacities": ("opacities", "opacity", "density", "logit_opacities"),  # 3DGRUT, fVDB
    "sh0": (
        *("sh0", "f_dc", "features_dc", "colors"),  # nerfstudio, gsplat's --app_opt
        *("features_albedo", "shs_dc"),  # 3DGRUT, gaussian-splatting-lightning
        *("sh_dc", "sh_coefficients_0"),  # drivestudio, Faster-GS
    ),
    "shN": (
        *("shN", "f_rest", "features_rest"),
        *("features_specular", "shs_rest"),
        *("sh_rest", "sh_coefficients_rest"),
    ),
}
GAUSSIAN = tuple(GAUSSIAN_NAMES)
# Groups of public trainers that are no Gaussian parameters, though they may have as many rows:
# inputs of networks (3DGRUT, gsplat's --app_opt, Scaffold-GS) by their whole names, ...
_OTHERS = frozenset({"features", "anchor_feat", "offset"})
# ... networks and what belongs to a photo by a whole word of the name.
_WORDS_OF_OTHERS = frozenset(
    (
        *("app", "appearance", "bilateral", "camera", "cameras", "embedding", "embeddings"),
        *("exposure", "exposures", "grid", "grids", "mlp", "pose", "poses"),
    )
)
MOMENTS = ("exp_avg", "exp_avg_sq", "max_exp_avg_sq")  # torch's names of Adam's, the last amsgrad's
ADAM_KEYS = ("step", *MOMENTS)
SLOT = "gaussian"  # of a parameter group: gsplat's name of what it holds
_CANONICAL = {alias: name for name, aliases in GAUSSIAN_NAMES.items() for alias in aliases}


def split_name(name: Any) -> tuple[str, str | None]:
    """The set of Gaussians and gsplat's name of a group's name, as drivestudio's `Background#xyz`.

    The set is "" where there is none; the second is None for any other group.
    """
    if not isinstance(name, str):
        return "", None
    prefix, _, last = name.rpartition("#")
    return prefix, _CANONICAL.get(last)


def canonical_name(name: Any) -> str | None:
    """gsplat's name of a Gaussian parameter group, or None for any other group."""
    return split_name(name)[1]


def is_known_other(name: Any) -> bool:
    """Whether a group's name says that it is no Gaussian parameter."""
    last = str(name).rpartition("#")[2].lower()
    return last in _OTHERS or not _WORDS_OF_OTHERS.isdisjoint(re.split(r"[\W_]+", last))


class NamedGroup(dict[str, Any]):
    """A parameter group that knows which Gaussian parameter it holds, and what is kept for it.

    `group["gaussian"]` is gsplat's name of it, or None, but no key of the group: torch's flat
    distributed checkpoints ask every stored checkpoint for all keys of the present groups, so that
    one of a stock trainer could not be loaded any more.

    Attributes:
        records: by parameter, a `state.ParameterRecord`.
    """

    def __init__(
        self,
        group: Mapping[str, Any],
        set_name: str,
        gaussian: str | None,
        records: Iterable[Any] = (),
    ) -> None:
        super().__init__(group)
        self.set_name, self.gaussian, self.records = set_name, gaussian, list(records)
        # What stood in its place, which somebody may hold and go on to write into.
        self._former = group if type(group) is dict else None
        self._was = {key: value for key, value in group.items() if key != "params"}

    def __missing__(self, key: str) -> Any:
        if key == SLOT:
            return self.gaussian
        raise KeyError(key)

    def get(self, key: str, default: Any = None) -> Any:
        return super().get(key, self.gaussian if key == SLOT else default)

    def written_elsewhere(self) -> str | None:
        """The option that somebody has changed in the group that stood in its place, or None."""
        former = self._former
        if former is None or former.get("params") is not self["params"]:
            self._former = None  # gives the memory of replaced parameters back
            return None
        pairs = [(key, was, former.get(key)) for key, was in self._was.items()]
        return next(
            (
                key
                for key, was, now in pairs
                # A device's number is not read.
                if now is not was and (Tensor in (type(now), type(was)) or now != was)
            ),
            None,
        )

    def __reduce__(self) -> Any:
        return NamedGroup, (dict(self), self.set_name, self.gaussian, self.records)


def gaussian_of(group: Mapping[str, Any]) -> str | None:
    """gsplat's name of the Gaussian parameter that a group holds, or None."""
    # Not by the mapping alone, which takes three times as long: every part asks in every step.
    return group.gaussian if type(group) is NamedGroup else group.get(SLOT)


def set_of(group: Mapping[str, Any]) -> str:
    """The set of Gaussians that a group belongs to, "" where an optimizer holds one."""
    return getattr(group, "set_name", "")


def free_slot(
    slot: tuple[str, str | None],
    groups: Iterable[Mapping[str, Any]],
    warn_once: Callable[[str, str], None],
) -> tuple[str, str | None]:
    """The set and the Gaussian parameter of a new group; none where one of the groups holds it."""
    held = [(each.set_name, each.gaussian) for each in groups if type(each) is NamedGroup]
    if slot[1] is None or slot not in held:
        return slot
    warn_once(
        "held twice",
        f"add_param_group: the parts act on the first group that holds {slot[1]!r} and leave the "
        "second alone; for two sets of Gaussians upgrade in one call, as a dict with keys such as "
        f"'first#{slot[1]}'",
    )
    return "", None


def group_name(index: int, group: Mapping[str, Any]) -> str:
    """How a group is called in messages."""
    return str(group.get("name") or group.get(SLOT) or f"group {index}")


def group_line(index: int, group: Mapping[str, Any]) -> str:
    """What a group says of itself in one line: its name, its sizes and its learning rate."""
    sizes = [list(param.shape) for param in group["params"]]
    size = sizes[0] if len(sizes) == 1 else f"{len(sizes)} tensors"
    return f"{group_name(index, group)} {size}: lr {float(group['lr']):.4g}"


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
