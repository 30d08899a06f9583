"""The loss: log space, a tone map that keeps its gradient, LPIPS from files."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from PIL import Image

from model.lpips import LPIPS, NETWORKS
from model.renderformer.losses import image_loss, log_radiance, tone_map
from model.weights import LPIPS_SET
from tests.model.lpips import distance, write_weights


def test_loss_is_l1_in_log_space():
    image = torch.rand(1, 2, 8, 8, 3) * 50
    assert image_loss(log_radiance(image), image, None, 0.0) == 0
    assert image_loss(log_radiance(image) + 0.25, image, None, 0.05).item() == pytest.approx(0.25, abs=1e-6)


def test_tone_map_shows_dark_values_and_passes_gradients():
    y = log_radiance(torch.tensor([0.0, 0.1, 1.0, 30.0])).requires_grad_()
    mapped = tone_map(y)
    torch.testing.assert_close(mapped.detach(), torch.tensor([0.0, math.log2(1.1), 1.0, 1.0]))
    mapped.sum().backward()
    assert y.grad[1] > 0


@pytest.mark.parametrize("network", ["vgg", "alex"])
def test_lpips_from_files(tmp_path, network):
    write_weights(tmp_path, network)
    metric = LPIPS.load(tmp_path, network)
    a = torch.rand(2, 3, 64, 64)
    assert torch.equal(metric(a, a), torch.zeros(2))
    near, far = metric(a, (a + 0.02).clamp(0, 1)), metric(a, 1 - a)
    assert (near > 0).all() and (far > near).all()


@pytest.mark.parametrize(("network", "wanted"), [("alex", (0.722, 0.138)), ("vgg", (0.569, 0.422))])
def test_the_published_weights_give_the_published_distances(shared_data, network, wanted):
    """Of the images that the metric's authors distribute with it."""
    if not all((LPIPS_SET.folder() / file.name).is_file() for file in NETWORKS[network]["files"]):
        pytest.skip(f"no weights in {LPIPS_SET.folder()}: lightmill weights lpips")
    files = (shared_data / "lpips" / f"ex_{name}.png" for name in ("ref", "p0", "p1"))
    reference, *others = (torch.from_numpy(np.array(Image.open(path))[..., :3] / 255).float() for path in files)
    reference, *others = (image.permute(2, 0, 1)[None] for image in (reference, *others))
    metric = LPIPS.load(None, network)
    assert [metric(reference, other).item() for other in others] == pytest.approx(wanted, abs=1e-3)


@pytest.mark.parametrize("network", ["vgg", "alex"])
def test_lpips_equals_its_definition(tmp_path, network, monkeypatch):
    write_weights(tmp_path, network)
    monkeypatch.setenv("LIGHTMILL_LPIPS", str(tmp_path))
    metric = LPIPS.load(None, network)
    rng = np.random.default_rng(3)
    a, b = (rng.uniform(size=(3, 36, 40)) for _ in range(2))
    measured = metric(*(torch.from_numpy(image).float()[None] for image in (a, b))).item()
    assert measured == pytest.approx(distance(tmp_path, network, a, b), rel=1e-4)


@pytest.mark.parametrize("network", ["vgg", "alex"])
def test_lpips_of_a_part_is_that_of_its_pixels(tmp_path, network):
    write_weights(tmp_path, network)
    metric, (a, b) = LPIPS.load(tmp_path, network), torch.rand(2, 1, 3, 256, 256)
    counts = torch.zeros(256, 256, dtype=torch.bool)
    assert metric(a, b, ~counts).item() == pytest.approx(metric(a, b).item(), rel=1e-5)
    counts[:, :128] = True
    left = metric(a[..., :128], b[..., :128]).item()
    half = torch.where(counts, b, a)  # as scores are taken: what does not count is as it should be
    assert metric(a, half, counts).item() == pytest.approx(left, rel=0.1) and metric(a, half).item() < 0.6 * left


def test_the_gradient_goes_through_the_tone_map(tmp_path):
    """Of the LPIPS part alone, against finite differences; where the tone map clamps there is none."""
    write_weights(tmp_path, "alex")
    metric = LPIPS.load(tmp_path, "alex").double()
    random = torch.Generator().manual_seed(5)
    y = torch.rand(1, 1, 32, 32, 3, generator=random, dtype=torch.float64) * 0.2 + 0.05  # radiance up to 0.78
    y[..., :8, :, :] = 0.5  # radiance 2.2: white
    image = torch.rand(1, 1, 32, 32, 3, generator=random, dtype=torch.float64)

    def distance(y):
        a, b = (tone_map(x).flatten(0, 1).permute(0, 3, 1, 2) for x in (y, log_radiance(image)))
        return metric(a, b).mean()

    y.requires_grad_()
    (gradient,) = torch.autograd.grad(distance(y), y)
    assert (gradient[..., :8, :, :] == 0).all()
    for _ in range(3):
        direction = torch.randn(y.shape, generator=random, dtype=torch.float64)
        step = 1e-6 * direction
        with torch.no_grad():
            slope = (distance(y + step) - distance(y - step)) / 2e-6
        assert (gradient * direction).sum().item() == pytest.approx(slope.item(), rel=1e-3)


def test_lpips_gradient_is_finite_also_on_black(tmp_path):
    write_weights(tmp_path, "vgg")
    metric = LPIPS.load(tmp_path)
    for y in (torch.zeros(1, 1, 32, 32, 3), torch.rand(1, 1, 32, 32, 3) * 0.2):
        y.requires_grad_()
        image_loss(y, torch.full((1, 1, 32, 32, 3), 0.1), metric, 0.05).backward()
        assert y.grad.isfinite().all() and y.grad.abs().sum() > 0


def test_missing_lpips_weights_say_where_to_get_them(tmp_path, monkeypatch):
    monkeypatch.delenv("LIGHTMILL_LPIPS", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    with pytest.raises(ValueError, match=r"vgg16.safetensors.*lightmill weights lpips.*vgg16-397923af.pth.*lpips=0"):
        LPIPS.load(tmp_path)
    with pytest.raises(ValueError, match="cache.*lightmill weights lpips.*lpips_folder"):
        LPIPS.load(None)
    write_weights(tmp_path, "vgg")
    torch.save({"lin0": torch.zeros(1)}, tmp_path / "vgg.pth")
    with pytest.raises(ValueError, match="does not hold"):
        LPIPS.load(tmp_path)
