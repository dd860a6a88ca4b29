"""The names that trainers give Gaussian parameters."""

from collections.abc import Mapping
from typing import Any

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
_CANONICAL = {alias: name for name, aliases in GAUSSIAN_NAMES.items() for alias in aliases}


def split_name(name: Any) -> tuple[str, str | None]:
    """The set of Gaussians and gsplat's name of a group's name, as drivestudio's `Background#xyz`.

    The set is "" where there is none; the second is None for any other group.
    """
    if not isinstance(name, str):
        return "", None
    prefix, _, last = name.rpartition("#")
    return prefix, _CANONICAL.get(last)
