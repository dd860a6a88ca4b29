"""LPIPS of renders, by a tool of the user's: AlexNet, inputs in -1..1, mean over the test views.

The tool is a Python file with `load(weights_dir, net)` and `lpips(model, a, b)` for images
[B, 3, H, W] in -1..1: a thin wrapper of any implementation (the `lpips` package needs torchvision
and a download).
"""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from splatting.scenes import Scene
from torch import Tensor

NET = "alex"


def load_tool(path: Path) -> Any:
    """The file as a module."""
    spec = importlib.util.spec_from_file_location("perceptual_tool", path)
    if spec is None or spec.loader is None:
        raise ValueError(f"{path}: not a Python file")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def mean_lpips(tool: Any, model: Any, scene: Scene, renders: Sequence[np.ndarray]) -> float:
    """Mean over the test views.

    Args:
        renders: [H, W, 3] uint8 each, in the order of `scene.test`.
    """

    def as_input(image: Tensor) -> Tensor:
        return image.permute(2, 0, 1)[None] * 2.0 - 1.0

    values = [
        float(tool.lpips(model, as_input(torch.from_numpy(render) / 255.0), as_input(view.image)))
        for view, render in zip(scene.test, renders, strict=True)
    ]
    return sum(values) / len(values)
