"""The pinhole camera shared by scene reading and the rasterizers."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Camera:
    """A pinhole camera in the OpenCV convention (x right, y down, z forward)."""

    viewmat: Tensor  # [4, 4] world to camera, world units
    fx: float  # pixels
    fy: float  # pixels
    cx: float  # pixels; the centre of the left-most pixel is at 0.5
    cy: float  # pixels
    width: int
    height: int

    @property
    def position(self) -> Tensor:
        """The camera centre in world coordinates, [3]."""
        rotation, translation = self.viewmat[:3, :3], self.viewmat[:3, 3]
        return -rotation.T @ translation

    def to(self, dtype: torch.dtype) -> Camera:
        """The same camera with its pose in `dtype`."""
        return Camera(
            self.viewmat.to(dtype), self.fx, self.fy, self.cx, self.cy, self.width, self.height
        )
