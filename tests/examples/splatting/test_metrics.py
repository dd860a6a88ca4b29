"""Image metrics: against scikit-image, closed forms and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity
from splatting.metrics import photometric_loss, psnr, ssim, ssim_map


def _pair(height: int, width: int, dtype: torch.dtype = torch.float32):
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(height, width, 3, generator=generator, dtype=dtype)
    noise = torch.randn(height, width, 3, generator=generator, dtype=dtype)
    return (target + 0.1 * noise).clamp(0, 1), target


def _gradient_pair():
    rows, columns = np.meshgrid(np.linspace(0, 1, 48), np.linspace(0, 1, 37), indexing="ij")
    smooth = np.stack([rows, columns, rows * columns], axis=-1)
    return torch.from_numpy(0.9 * smooth + 0.05), torch.from_numpy(smooth)


# float32 loses digits where the image is smooth: the variance is then a small difference of
# numbers near 1, and is compared with C2 = 9e-4. scikit-image loses as many, so the smooth pair
# is compared in float64.
@pytest.mark.parametrize(
    ("pair", "tolerance"),
    [
        (_pair(40, 53), 2e-5),
        (_pair(106, 160), 2e-5),
        (_pair(40, 53, torch.float64), 1e-12),
        (_gradient_pair(), 1e-12),
    ],
)
def test_ssim_equals_scikit_image_in_the_valid_area(pair, tolerance):
    render, target = pair
    reference = structural_similarity(
        render.numpy(),
        target.numpy(),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        channel_axis=2,
        data_range=1.0,
        full=True,
    )[1]
    ours = ssim_map(render, target).numpy()[5:-5, 5:-5]
    np.testing.assert_allclose(ours, reference[5:-5, 5:-5], atol=tolerance)


def _dense_ssim_map(render: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Zero-padded SSIM from a dense 2-D window: the slow, obvious twin."""
    offsets = torch.arange(-5, 6, dtype=torch.float64)
    window = torch.exp(-(offsets[:, None] ** 2 + offsets[None] ** 2) / (2 * 1.5**2))
    kernel = (window / window.sum())[None, None]

    def blur(image: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.conv2d(image.permute(2, 0, 1)[:, None], kernel, padding=5)

    mu_r, mu_t = blur(render), blur(target)
    var_r, var_t = blur(render**2) - mu_r**2, blur(target**2) - mu_t**2
    covariance = blur(render * target) - mu_r * mu_t
    top = (2 * mu_r * mu_t + 0.01**2) * (2 * covariance + 0.03**2)
    bottom = (mu_r**2 + mu_t**2 + 0.01**2) * (var_r + var_t + 0.03**2)
    return (top / bottom)[:, 0].permute(1, 2, 0)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 7), (5, 3), (6, 12), (30, 21)])
def test_ssim_pads_with_zeros_up_to_the_border(height, width):
    render, target = _pair(height, width, torch.float64)
    expected = _dense_ssim_map(render, target)
    # 1e-12: the order of 121 float64 additions differs, over C2 = 9e-4.
    torch.testing.assert_close(ssim_map(render, target), expected, rtol=0, atol=1e-12)


@pytest.mark.thorough
def test_ssim_gradients():
    render, target = (image.requires_grad_() for image in _pair(7, 13, torch.float64))
    assert torch.autograd.gradcheck(ssim, (render, target))
    assert torch.autograd.gradgradcheck(lambda image: ssim(image, target.detach()), (render,))


def test_psnr_known_values_and_one_number_an_image():
    target = torch.full((2, 4, 5, 3), 0.5)
    render = target + torch.tensor([0.1, 0.01])[:, None, None, None]
    # 10 log10(1 / 0.1^2) = 20 and 40; float32 holds 0.51 - 0.5 to 1e-6 relative
    torch.testing.assert_close(psnr(render, target), torch.tensor([20.0, 40.0]), rtol=1e-5, atol=0)
    assert ssim(render, target).shape == (2,)


def test_photometric_loss_is_the_weighted_sum_and_takes_another_pixel_loss():
    render, target = _pair(16, 18)
    l1 = (render - target).abs().mean()
    expected = 0.8 * l1 + 0.2 * (1 - ssim(render, target))
    torch.testing.assert_close(photometric_loss(render, target), expected)
    l2 = torch.nn.functional.mse_loss(render, target)
    swapped = photometric_loss(render, target, torch.nn.functional.mse_loss)
    torch.testing.assert_close(swapped, expected + 0.8 * (l2 - l1))


@pytest.mark.parametrize("shape", [(40, 53, 3), (5, 3, 3), (1, 1, 3), (11, 8, 1), (16, 64, 4)])
def test_compiled_ssim_is_that_of_the_map(shape):
    generator = torch.Generator().manual_seed(0)
    render = torch.rand(shape, generator=generator)
    target = render + 0.2 * torch.randn(shape, generator=generator)
    exact = render.double().requires_grad_()
    expected = photometric_loss(exact, target.double())
    expected.backward()
    results = []
    for _ in range(2):
        fast = render.clone().requires_grad_()
        loss = photometric_loss(fast, target)
        loss.backward()
        results.append((loss.detach(), fast.grad))
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))
    loss, grad = results[0]
    assert abs(loss.item() - expected.item()) < 1e-6
    # float32 moments, of which the variance is a difference
    exact_grad = exact.grad
    assert exact_grad is not None
    assert (grad - exact_grad).abs().max() < 1e-5 * exact_grad.abs().max()


def test_loss_is_compiled_only_where_its_gradient_is_enough():
    images = torch.rand(2, 9, 8, 3, generator=torch.Generator().manual_seed(0)).requires_grad_()
    loss = photometric_loss(images[0], images[1])  # the target has a gradient too
    (first,) = torch.autograd.grad(loss, images, create_graph=True)
    (second,) = torch.autograd.grad(first.square().sum(), images)
    assert first[1].abs().max() > 0
    assert second.isfinite().all()
