"""The loss: log space, a tone map that keeps its gradient, LPIPS from files."""

from __future__ import annotations

import math

import pytest
import torch

from model.losses import LPIPS, NETWORKS, image_loss, log_radiance, tone_map


def write_weights(folder, network: str) -> None:
    """Random weights in the layout of the published files."""
    torch.manual_seed(1)
    spec = NETWORKS[network]
    metric = LPIPS(network)
    features = {"classifier.0.weight": torch.zeros(1)}
    number = 0
    for layer, stage in zip(spec["layers"], metric.stages, strict=True):
        if len(layer) == 4:
            features[f"features.{number}.weight"] = torch.randn_like(stage.weight) / math.sqrt(stage.weight[0].numel())
            features[f"features.{number}.bias"] = torch.randn_like(stage.bias) * 0.1
        number += 2 if len(layer) == 4 else 1  # a ReLU follows each convolution
    torch.save(features, folder / spec["features"][0])
    linear = {f"lin{i}.model.1.weight": torch.rand_like(parameter) for i, parameter in enumerate(metric.linear)}
    torch.save(linear, folder / spec["linear"][0])


def test_loss_is_l1_in_log_space():
    image = torch.rand(1, 2, 8, 8, 3) * 50
    assert image_loss(log_radiance(image), image, None, 0.0) == 0
    assert image_loss(log_radiance(image) + 0.25, image, None, 0.05).item() == pytest.approx(0.25, abs=1e-6)


def test_tone_map_shows_dark_values_and_passes_gradients():
    y = log_radiance(torch.tensor([0.0, 0.1, 1.0, 30.0])).requires_grad_()
    shown = tone_map(y)
    torch.testing.assert_close(shown.detach(), torch.tensor([0.0, math.log2(1.1), 1.0, 1.0]))
    shown.sum().backward()
    assert y.grad[1] > 0


@pytest.mark.parametrize("network", ["vgg", "alex"])
def test_lpips_from_files(tmp_path, network):
    write_weights(tmp_path, network)
    metric = LPIPS.load(tmp_path, network)
    a = torch.rand(2, 3, 64, 64)
    assert torch.equal(metric(a, a), torch.zeros(2))
    near, far = metric(a, (a + 0.02).clamp(0, 1)), metric(a, 1 - a)
    assert (near > 0).all() and (far > near).all()


def test_lpips_gradient_is_finite_also_on_black(tmp_path):
    write_weights(tmp_path, "vgg")
    metric = LPIPS.load(tmp_path)
    for y in (torch.zeros(1, 1, 32, 32, 3), torch.rand(1, 1, 32, 32, 3) * 0.2):
        y.requires_grad_()
        image_loss(y, torch.full((1, 1, 32, 32, 3), 0.1), metric, 0.05).backward()
        assert y.grad.isfinite().all() and y.grad.abs().sum() > 0


def test_missing_lpips_weights_say_where_to_get_them(tmp_path):
    with pytest.raises(ValueError, match=r"vgg16-397923af.pth.*https://.*lpips=0"):
        LPIPS.load(tmp_path)
    with pytest.raises(ValueError, match="lpips_folder"):
        LPIPS.load(None)
    write_weights(tmp_path, "vgg")
    torch.save({"lin0": torch.zeros(1)}, tmp_path / "vgg.pth")
    with pytest.raises(ValueError, match="do not hold"):
        LPIPS.load(tmp_path)
