"""The mean structural similarity of two images and its gradient, compiled, in float32.

The twin of `metrics.ssim` for training: one pass over the rows takes the five local moments and
the similarity, a second one the gradient, so that no image-sized moment is ever stored.
"""

# numba passes intrinsics their typing context itself
# pyright: reportCallIssue=false
from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatting.fast.kernel import kernel
from splatting.fast.lanes import WIDTH, choose, count_up, load, multiply_add, repeat, store, total


@kernel
def _blur_along(line, at, step, weights):
    """The window at eight places of a padded line, whose neighbours are `step` apart."""
    radius = weights.shape[0] // 2
    result = repeat(0.0)
    for tap in range(weights.shape[0]):
        value = load(line, at + (tap - radius) * step)
        result = multiply_add(value, weights[tap], result)
    return result


@kernel
def _similarity_rows(render, target, height, length, channels, weights, c1, c2, by_moments):
    """The sum of the similarity's map; its derivatives by three moments to `by_moments`.

    `render`, `target` [H * L] with rows padded to L, a multiple of eight; `by_moments`
    [3 * H * L] by the blurred render, its square and its product with the target.
    """
    padded = render.shape[0] // height
    radius = weights.shape[0] // 2
    margin = radius * channels
    line = padded + 2 * margin
    moments = np.zeros(5 * line, np.float32)
    plane = height * padded
    result = 0.0
    for row in range(height):
        for block in range(0, padded, WIDTH):
            mean_r, mean_t = repeat(0.0), repeat(0.0)
            square_r, square_t, product = repeat(0.0), repeat(0.0), repeat(0.0)
            for other in range(max(row - radius, 0), min(row + radius + 1, height)):
                weight = weights[other - row + radius]
                r, t = load(render, other * padded + block), load(target, other * padded + block)
                weighted_r, weighted_t = weight * r, weight * t
                mean_r = mean_r + weighted_r
                mean_t = mean_t + weighted_t
                square_r = multiply_add(weighted_r, r, square_r)
                square_t = multiply_add(weighted_t, t, square_t)
                product = multiply_add(weighted_r, t, product)
            at = margin + block
            store(moments, at, mean_r)
            store(moments, line + at, mean_t)
            store(moments, 2 * line + at, square_r)
            store(moments, 3 * line + at, square_t)
            store(moments, 4 * line + at, product)
        sums = repeat(0.0)
        for block in range(0, padded, WIDTH):
            at = margin + block
            mean_r = _blur_along(moments, at, channels, weights)
            mean_t = _blur_along(moments, line + at, channels, weights)
            square_r = _blur_along(moments, 2 * line + at, channels, weights)
            square_t = _blur_along(moments, 3 * line + at, channels, weights)
            product = _blur_along(moments, 4 * line + at, channels, weights)
            # Wang et al. 2004, eq. 13
            means, squares = mean_r * mean_t, mean_r * mean_r + mean_t * mean_t
            luminance, structure = 2.0 * means + c1, 2.0 * (product - means) + c2
            brightness, variance = squares + c1, square_r + square_t - squares + c2
            scale = 1.0 / (brightness * variance)
            inside = count_up() + float(block) < float(length)
            similarity = luminance * structure * scale
            sums = sums + choose(inside, similarity, 0.0)
            by_mean = 2.0 * mean_t * (structure - luminance) * scale
            by_mean = by_mean + 2.0 * mean_r * similarity * (1.0 / variance - 1.0 / brightness)
            at = row * padded + block
            store(by_moments, at, choose(inside, by_mean, 0.0))
            store(by_moments, plane + at, choose(inside, 0.0 - similarity / variance, 0.0))
            by_product = 2.0 * luminance * scale
            store(by_moments, 2 * plane + at, choose(inside, by_product, 0.0))
        result += total(sums)
    return result


@kernel
def _gradient_rows(render, target, height, channels, weights, by_moments, grad):
    """The gradient by the render of the sum that `_similarity_rows` returned."""
    padded = render.shape[0] // height
    radius = weights.shape[0] // 2
    margin = radius * channels
    line = padded + 2 * margin
    blurred = np.zeros(3 * line, np.float32)
    plane = height * padded
    for row in range(height):
        for block in range(0, padded, WIDTH):
            by_mean, by_square, by_product = repeat(0.0), repeat(0.0), repeat(0.0)
            for other in range(max(row - radius, 0), min(row + radius + 1, height)):
                weight = weights[other - row + radius]
                at = other * padded + block
                by_mean = multiply_add(load(by_moments, at), weight, by_mean)
                by_square = multiply_add(load(by_moments, plane + at), weight, by_square)
                by_product = multiply_add(load(by_moments, 2 * plane + at), weight, by_product)
            at = margin + block
            store(blurred, at, by_mean)
            store(blurred, line + at, by_square)
            store(blurred, 2 * line + at, by_product)
        for block in range(0, padded, WIDTH):
            at = margin + block
            by_mean = _blur_along(blurred, at, channels, weights)
            by_square = _blur_along(blurred, line + at, channels, weights)
            by_product = _blur_along(blurred, 2 * line + at, channels, weights)
            at = row * padded + block
            by_render = multiply_add(2.0 * load(render, at), by_square, by_mean)
            store(grad, at, multiply_add(load(target, at), by_product, by_render))


class MeanSimilarity(torch.autograd.Function):
    """Two images [H, W, C] to their mean structural similarity; see `metrics.ssim`.

    `window` holds the normalised weights, `constants` C1 and C2. The target gets no gradient.
    """

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        render: Tensor,
        target: Tensor,
        window: list[float],
        constants: tuple[float, float],
    ) -> Tensor:
        height, width, channels = render.shape
        length = width * channels
        padded = -(-length // WIDTH) * WIDTH
        images = np.zeros((2, height, padded), np.float32)
        for image, tensor in zip(images, (render, target), strict=True):
            image[:, :length] = tensor.detach().reshape(height, length).numpy()
        flat = images.reshape(2, -1)
        weights = np.array(window, np.float32)
        by_moments = np.empty(3 * height * padded, np.float32)
        constants32 = np.array(constants, np.float32)
        shape = height, length, channels
        result = _similarity_rows(*flat, *shape, weights, *constants32, by_moments)
        ctx.saved = flat, shape, weights, by_moments
        ctx.shape = render.shape
        return torch.tensor(result / render.numel(), dtype=torch.float32)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_mean: Tensor) -> Any:  # type: ignore[override]
        flat, (height, length, channels), weights, by_moments = ctx.saved
        grad = np.empty_like(flat[0])
        _gradient_rows(*flat, height, channels, weights, by_moments, grad)
        rows = torch.from_numpy(grad.reshape(height, -1)[:, :length])
        by_render = rows * (grad_mean / (height * length))
        return by_render.reshape(ctx.shape), None, None, None
