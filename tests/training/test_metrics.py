"""Metrics agree with scikit-image and torchmetrics, and obey what their definitions imply."""

from __future__ import annotations

import math

import pytest
import torch

from visdom_plugin.render import quantise
from visdom_plugin.training import metrics


@pytest.fixture
def pair():
    draw = torch.Generator().manual_seed(0)
    y = torch.nn.functional.interpolate(torch.rand(1, 3, 9, 11, generator=draw), (45, 52), mode="bicubic")[0]
    y = y.permute(1, 2, 0)
    x = y + 0.1 * torch.randn(45, 52, 3, generator=draw) * torch.tensor([0.3, 1.0, 2.0])
    return quantise(x), quantise(y)


def test_psnr_agrees_with_scikit_image_and_torchmetrics(pair):
    from skimage.metrics import peak_signal_noise_ratio
    from torchmetrics.functional.image import peak_signal_noise_ratio as theirs

    x, y = pair
    assert metrics.psnr(x, y) == pytest.approx(
        peak_signal_noise_ratio(y.numpy(), x.numpy(), data_range=1), abs=1e-9
    )
    assert metrics.psnr(x, y) == pytest.approx(float(theirs(x, y, data_range=1.0)), abs=1e-4)


def test_ssim_agrees_with_scikit_image(pair):
    ssim = pytest.importorskip("visdom_plugin.ssim").ssim
    from skimage.metrics import structural_similarity

    x, y = pair
    # scikit-image mirrors at the border where 3DGS pads with zeros: a black frame wider than the window makes
    # the two the same.
    wide = [torch.nn.functional.pad(i, (0, 0, 11, 11, 11, 11)).numpy() for i in (x, y)]
    settings = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "full": True}
    _, theirs = structural_similarity(*wide, data_range=1, channel_axis=2, **settings)
    assert float(ssim(x.float(), y.float())) == pytest.approx(theirs[11:-11, 11:-11].mean(), abs=1e-5)


def test_per_channel_psnr_is_never_below_global_and_equal_for_equal_channels(pair):
    x, y = pair
    assert metrics.psnr_per_channel(x, y) > metrics.psnr(x, y)
    grey = [i.mean(-1, keepdim=True).expand(-1, -1, 3) for i in (x, y)]
    assert metrics.psnr_per_channel(*grey) == pytest.approx(metrics.psnr(*grey), abs=1e-9)


def test_foreground_psnr_sees_the_mask_alone(pair):
    x, y = pair
    mask = torch.zeros(x.shape[:2], dtype=torch.bool)
    mask[10:30, 5:40] = True
    cut = metrics.psnr(x[10:30, 5:40], y[10:30, 5:40])
    noisy = torch.where(mask[..., None], x, 1 - x)
    assert (
        metrics.psnr_foreground(x, y, mask) == metrics.psnr_foreground(noisy, y, mask) == pytest.approx(cut)
    )
    assert math.isnan(metrics.psnr_foreground(x, y, torch.zeros_like(mask)))


def test_quantised_images_are_what_an_8_bit_file_holds():
    x = torch.tensor([-0.3, 0.0, 0.4999 / 255, 0.5001 / 255, 0.699, 1.0, 1.2])
    assert (quantise(x) * 255).tolist() == [0, 0, 0, 1, 178, 255, 255]
    assert torch.equal(quantise(quantise(x)), quantise(x))


def test_the_photographs_background_does_not_count(pair):
    image = (pair[1] * 255).to(torch.uint8)
    mask = torch.rand(image.shape[:2], generator=torch.Generator().manual_seed(1)) < 0.5
    other = torch.where(mask[..., None], image, 255 - image)
    assert torch.equal(metrics.whiten(image, mask), metrics.whiten(other, mask))
    assert bool((metrics.whiten(image, mask)[~mask] == 1).all())


def test_iou_and_outside_mass_of_overlapping_squares():
    alpha, mask = torch.zeros(20, 20), torch.zeros(20, 20, dtype=torch.bool)
    assert metrics.silhouette_iou(alpha, mask) == 1 and metrics.outside_hull_mass(alpha, mask) == 0
    alpha[0:10, 0:10], mask[0:10, 5:15] = 0.8, True
    assert metrics.silhouette_iou(alpha, mask) == pytest.approx(50 / 150)
    assert metrics.outside_hull_mass(alpha, mask) == pytest.approx(0.5)
    alpha[0:10, 5:10] = 0.4
    assert metrics.silhouette_iou(alpha, mask) == 0
    assert metrics.outside_hull_mass(alpha, mask) == pytest.approx(2 / 3)
    assert metrics.outside_hull_mass(alpha, alpha > 0) == 0


def test_means_skip_views_where_a_metric_is_undefined():
    row = dict.fromkeys(metrics.NAMES, 1.0)
    means = metrics.mean_over_views(
        [row, row | {"psnr": 4.0, "psnr_foreground": math.nan, "lpips": math.nan}]
    )
    assert means["psnr"] == 2.5 and means["psnr_foreground"] == 1 and means["lpips"] == 1
    assert math.isnan(metrics.mean_over_views([row | {"lpips": math.nan}])["lpips"])


def test_lpips_hands_the_network_its_own_range(pair):
    seen = []

    def network(a, b):
        seen.extend((a, b))
        return (a - b).abs().mean()[None, None, None, None]

    value = metrics.lpips(network, *pair)
    assert [tuple(i.shape) for i in seen] == [(1, 3, 45, 52)] * 2
    assert value == pytest.approx(2 * float((pair[0] - pair[1]).abs().mean()), rel=1e-5)
    assert torch.allclose(seen[1][0].permute(1, 2, 0).double(), 2 * pair[1] - 1, atol=1e-6)


def test_lpips_without_weights_says_so_and_downloads_nothing(monkeypatch, tmp_path, caplog):
    import sys
    from types import SimpleNamespace

    built = []
    monkeypatch.setitem(sys.modules, "lpips", SimpleNamespace(LPIPS=lambda **k: built.append(k)))
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    assert metrics.load_lpips() is None and not built
    assert "weights are not at" in caplog.text and "visdom-eval" in caplog.text
    monkeypatch.setitem(sys.modules, "lpips", None)
    caplog.clear()
    assert metrics.load_lpips() is None and not caplog.text


def test_ignored_pixels_are_not_measured():
    draw = torch.Generator().manual_seed(5)
    rgb, alpha = torch.rand(30, 40, 3, generator=draw), torch.rand(30, 40, generator=draw)
    image = (torch.rand(30, 40, 3, generator=draw) * 255).to(torch.uint8)
    mask, seen = torch.rand(30, 40, generator=draw) > 0.4, torch.rand(30, 40, generator=draw) > 0.4
    ignore = torch.zeros(30, 40, dtype=torch.bool)
    ignore[:, 25:] = True
    ignore[10:14, 3:9] = True
    plain = metrics.compare(rgb, alpha, image, mask, hull_silhouette=seen)
    none = metrics.compare(rgb, alpha, image, mask, hull_silhouette=seen, ignore=torch.zeros_like(ignore))
    assert all(plain[n] == none[n] for n in metrics.NAMES if n != "lpips")
    results = []
    for value in (0.0, 1.0):
        results.append(
            metrics.compare(
                torch.where(ignore[..., None], value, rgb),
                torch.where(ignore, value, alpha),
                torch.where(ignore[..., None], int(255 * (1 - value)), image),
                torch.where(ignore, value > 0, mask),
                hull_silhouette=torch.where(ignore, value == 0, seen),
                ignore=ignore,
            )
        )
    one, other = results
    assert all(one[n] == other[n] for n in metrics.NAMES if n != "lpips")
    assert all(one[n] != plain[n] for n in metrics.NAMES if n != "lpips")
    # A picture that is ignored but for a block is that block.
    block = ~ignore
    block[:, 25:], block[10:14] = False, False
    only = metrics.compare(rgb, alpha, image, mask, ignore=~block)
    cut = metrics.compare(rgb[:10, :25], alpha[:10, :25], image[:10, :25], mask[:10, :25])
    rest = metrics.compare(rgb[14:, :25], alpha[14:, :25], image[14:, :25], mask[14:, :25])
    mean = (10 * 10 ** (-cut["psnr"] / 10) + 16 * 10 ** (-rest["psnr"] / 10)) / 26
    assert only["psnr"] == pytest.approx(-10 * math.log10(mean))
    assert all(math.isnan(v) for v in metrics.compare(rgb, alpha, image, mask, ignore=ignore | True).values())


def test_ssim_with_ignored_pixels_charges_the_others_with_all_that_differs():
    from visdom_plugin.ssim import ssim

    torch.manual_seed(3)
    image = (torch.rand(40, 48, 3) * 255).to(torch.uint8)
    rgb, alpha, mask = torch.rand(40, 48, 3), torch.ones(40, 48), torch.ones(40, 48, dtype=torch.bool)
    ignore = torch.zeros(40, 48, dtype=torch.bool)
    ignore[:, 30:] = True
    found = metrics.compare(rgb, alpha, image, mask, ignore=ignore)["ssim"]
    x, y = (
        torch.where(ignore[..., None], 1.0, z) for z in (quantise(rgb), quantise(metrics.whiten(image, mask)))
    )
    whole = float(ssim(x.float(), y.float()))
    assert found == pytest.approx(1 - (1 - whole) * 48 / 30, abs=1e-9) and found < whole


def test_ssim_over_uniform_windows_is_the_mean_over_all_windows_inside():
    """The definition, written out: sample variances over each 7 x 7 window, channels apart."""
    generator = torch.Generator().manual_seed(4)
    x, y = torch.rand(2, 13, 11, 3, generator=generator, dtype=torch.float64)
    values = []
    for channel in range(3):
        for row in range(13 - 6):
            for column in range(11 - 6):
                a, b = (z[row : row + 7, column : column + 7, channel].flatten() for z in (x, y))
                covariance = torch.cov(torch.stack([a, b]))
                luminance = (2 * a.mean() * b.mean() + 1e-4) / (a.mean() ** 2 + b.mean() ** 2 + 1e-4)
                contrast = (2 * covariance[0, 1] + 9e-4) / (covariance[0, 0] + covariance[1, 1] + 9e-4)
                values.append(float(luminance * contrast))
    assert metrics.ssim_uniform7(x, y) == pytest.approx(sum(values) / len(values), abs=1e-12)
    assert metrics.ssim_uniform7(x, x) == pytest.approx(1) and math.isnan(metrics.ssim_uniform7(x[:6], y[:6]))
