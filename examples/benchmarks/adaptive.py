"""Training with clone, split, prune and reset: gsplat's own DefaultStrategy, on a CPU."""

from __future__ import annotations

import importlib
from typing import Any
from unittest.mock import patch

import torch
from splatting.density import Optimizers
from splatting.fit import Fit
from splatting.scenes import View
from torch import Tensor
from torch.nn import Parameter

GROW_GRAD = 2e-4  # gsplat's own threshold
# Pixels across the images that people train on; bonsai's are half of Mip-NeRF 360's.
FULL_WIDTH = {"bonsai": 1559, "lego": 800, "plush": 640, "train": 979}
_REFERENCE_RUN = 30_000  # iterations that gsplat's 500, 15,000, 100 and 3,000 were made for


class DefaultDensityControl:
    """gsplat's DefaultStrategy, as `Fit` calls density control.

    gsplat 1.5.3 never resets the opacities (`0 & step > 0` is false); the releases before and
    after it do, and so does this.

    Args:
        extent: the scene's, in world units.
        iterations: length of the whole run; the strategy's schedule is scaled to it.
        threshold: the gradient of the projected means above which it clones and splits.

    Attributes:
        state: the strategy's, part of a checkpoint.
        info: of the last rendering; the strategy reads the projected means' gradient from it.
    """

    def __init__(self, extent: float, iterations: int, threshold: float) -> None:
        # Where there is nvcc it would compile its CUDA extension, which no strategy needs.
        with patch("torch.utils.cpp_extension._find_cuda_home", lambda: None):
            default = importlib.import_module("gsplat.strategy.default")
        scale = iterations / _REFERENCE_RUN
        self.strategy: Any = default.DefaultStrategy(
            grow_grad2d=threshold,
            refine_start_iter=round(500 * scale),
            refine_stop_iter=round(15_000 * scale),
            refine_every=max(round(100 * scale), 1),
            reset_every=max(round(3_000 * scale), 1),
        )
        self.reset = default.reset_opa
        self.state: dict[str, Any] = self.strategy.initialize_state(scene_scale=extent)
        self.info: dict[str, Any] = {}

    def step(self, iteration: int, gaussians: dict[str, Parameter], optimizers: Optimizers) -> int:
        """What the strategy does after the optimizers' step; nothing is relocated."""
        strategy = self.strategy
        strategy.step_post_backward(
            gaussians, optimizers, self.state, iteration, self.info, packed=False
        )
        if 0 < iteration < strategy.refine_stop_iter and iteration % strategy.reset_every == 0:
            self.reset(gaussians, optimizers, self.state, 2 * strategy.prune_opa)
        return 0


class AdaptiveFit(Fit):
    """`Fit` with adaptive density control; it starts from `points` points and has no cap.

    The strategy's threshold is that of a gradient over the image's width, whatever its pixels. On
    images of a quarter of the width four times of it leaves as many Gaussians per pixel.
    """

    relocates = False

    def _density_control(self) -> DefaultDensityControl:
        self.draws["split"] = torch.default_generator  # which gsplat draws from
        width = self.scene.train[0].camera.width
        shrunk = FULL_WIDTH.get(self.scene.name, width) / width
        threshold = shrunk * GROW_GRAD * self.options.threshold
        return DefaultDensityControl(self.scene.extent, self.options.iterations, threshold)

    def _train_image(self, view: View) -> Tensor:
        density, camera = self.density, view.camera
        assert isinstance(density, DefaultDensityControl)
        means2d = torch.zeros(1, len(self.gaussians["means"]), 2, requires_grad=True)
        rendering = self._render(view, means2d[0])
        density.info = {
            "means2d": means2d,
            "radii": rendering.radii[None, :, None].expand(-1, -1, 2),
            "gaussian_ids": None,
            "width": camera.width,
            "height": camera.height,
            "n_cameras": 1,
        }
        return rendering.image
