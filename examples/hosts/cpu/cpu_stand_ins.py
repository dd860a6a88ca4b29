"""Modules that the trainers import and a try-out on a CPU does without.

A viewer, a logger or a perceptual metric that is not installed becomes an object that takes every
call and does nothing; one that is installed is used. Metrics that need downloaded networks are NaN.
"""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.machinery
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

VIEWERS = (
    "viser nerfview splines wandb icecream open3d lpips websockets mediapy trimesh tensorly mmcv"
)
OTHERS = "tensorboard torchvision imageio_ffmpeg exif fused_bilagrid"
ABSENT = {*VIEWERS.split(), *OTHERS.split()}


class Nothing:
    """Takes every call, has every attribute, and is empty."""

    def __init__(self, *_: Any, **__: Any) -> None:
        """Take anything."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return Nothing()

    def __call__(self, *_: Any, **__: Any) -> Any:
        return Nothing()

    def __enter__(self) -> Nothing:
        return self

    def __exit__(self, *_: Any) -> None:
        """Leave it."""

    def __iter__(self) -> Iterator[Any]:
        return iter(())


class Empty(types.ModuleType):
    """A module in which every name is a class that does nothing."""

    __path__ = []  # noqa: RUF012  # pyright: ignore  # a package: submodules are empty too

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        made = type(name, (Nothing,), {"__module__": self.__name__})
        setattr(self, name, made)
        return made


class Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Asked last: makes an `Empty` of a module in `ABSENT`."""

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> Any:
        """A spec for the modules named above."""
        if name.split(".", maxsplit=1)[0] in ABSENT:
            return importlib.machinery.ModuleSpec(name, self, is_package=True)
        return None

    def create_module(self, spec: Any) -> Empty:
        print(f"on_cpu: {spec.name} is not installed: a module that does nothing takes its place")
        return Empty(spec.name)

    def exec_module(self, module: Any) -> None:
        """Nothing to run."""


class NoMetric(torch.nn.Module):
    """A perceptual metric whose network would have to be downloaded: NaN."""

    def __init__(self, *_: Any, **__: Any) -> None:
        super().__init__()

    def forward(self, *_: Any) -> Tensor:
        return torch.tensor(float("nan"))


def install() -> None:
    """Make the modules importable."""
    sys.meta_path.append(Finder())
    if isinstance(importlib.import_module("tensorboard"), Empty):
        for name in ("torch.utils.tensorboard", "torch.utils.tensorboard.writer"):
            sys.modules[name] = Empty(name)
    metrics = types.ModuleType("torchmetrics.image.lpip")
    metrics.LearnedPerceptualImagePatchSimilarity = NoMetric  # type: ignore[attr-defined]
    sys.modules["torchmetrics.image.lpip"] = metrics
    lpips = types.ModuleType("lpipsPyTorch")
    lpips.lpips = lambda *_, **__: torch.tensor(float("nan"))  # type: ignore[attr-defined]
    sys.modules["lpipsPyTorch"] = lpips
    _torchvision()
    _scene_manager()


def _torchvision() -> None:
    """The two transforms that taming-3dgs uses, where torchvision is not installed."""
    module: Any = importlib.import_module("torchvision")
    if not isinstance(module, Empty):
        return
    transforms: Any = importlib.import_module("torchvision.transforms")
    setattr(module, "transforms", transforms)  # noqa: B010

    class ToPILImage:
        def __call__(self, image: Tensor) -> Any:
            from PIL import Image

            pixels = (image.clamp(0, 1) * 255).byte().permute(1, 2, 0).numpy()
            return Image.fromarray(pixels)

    class ToTensor:
        def __call__(self, image: Any) -> Tensor:
            pixels = torch.from_numpy(np.array(image)).float() / 255
            return pixels[None] if pixels.dim() == 2 else pixels.permute(2, 0, 1)

    transforms.ToPILImage, transforms.ToTensor = ToPILImage, ToTensor


def _scene_manager() -> None:
    """`pycolmap.SceneManager`, of a fork of pycolmap that gsplat up to 1.5 reads scenes with."""
    try:
        module: Any = importlib.import_module("pycolmap")
    except ImportError:
        module = types.ModuleType("pycolmap")
        sys.modules["pycolmap"] = module
    if not hasattr(module, "SceneManager"):
        module.SceneManager = SceneManager


class SceneManager:
    """What gsplat's example reads of a COLMAP model; tracks of the points are left out."""

    def __init__(self, folder: str) -> None:
        from splatting.colmap import read_colmap

        model = read_colmap(Path(folder))
        self.images = {k: _Image(k, image) for k, image in enumerate(model.images)}
        self.cameras = {k: _Camera(image) for k, image in enumerate(model.images)}
        self.points3D = model.points
        self.point3D_colors = (model.colors * 255).round()
        self.point3D_errors = np.zeros(len(model.points))
        self.name_to_image_id = {image.name: k for k, image in self.images.items()}
        self.point3D_id_to_images: dict[int, Any] = {}
        self.point3D_id_to_point3D_idx: dict[int, int] = {}

    def load_cameras(self) -> None:
        """They are loaded."""

    load_images = load_points3D = load_cameras  # noqa: N815 (their names)


class _Image:
    def __init__(self, index: int, image: Any) -> None:
        self.name, self.camera_id = image.name, index
        self._rotation, self.tvec = image.viewmat[:3, :3], image.viewmat[:3, 3]

    def R(self) -> np.ndarray:  # noqa: N802 (its name)
        """World to camera."""
        return self._rotation


class _Camera:
    camera_type = "PINHOLE"

    def __init__(self, image: Any) -> None:
        self.fx, self.fy, self.cx, self.cy = image.fx, image.fy, image.cx, image.cy
        self.width, self.height = image.width, image.height
