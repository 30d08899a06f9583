"""Our Inception network against its description, and its file."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from model.inception import FEATURES, Inception
from model.weights import INCEPTION_2015, read
from tests.model import inception


def test_the_network_equals_its_description(tmp_path):
    inception.write_weights(tmp_path)
    network, tensors = Inception.load(tmp_path), read(tmp_path / INCEPTION_2015.published)
    images = torch.rand(2, 3, 90, 160, generator=torch.Generator().manual_seed(2))
    with torch.inference_mode():
        found = network(images)
        wanted = inception.features(tensors, F.interpolate(images, (299, 299), mode="bilinear", align_corners=False))
    assert found.shape == (2, FEATURES)
    torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-4)
    assert (found[0] - found[1]).abs().mean() > 1e-3 and found.std() > 0.1


def test_the_network_has_the_published_number_of_parameters():
    """torchvision's 27,161,264 without its 1,000 classes and without the auxiliary classifier."""
    assert sum(parameter.numel() for parameter in Inception().parameters()) == 27_161_264 - 1000 * (2048 + 1) - 3_326_696


def test_a_file_of_another_network_is_refused(tmp_path):
    with pytest.raises(ValueError, match="lightmill weights inception.*evaluate.inception=false"):
        Inception.load(tmp_path)
    torch.save({"Conv2d_1a_3x3.conv.weight": torch.zeros(1)}, tmp_path / INCEPTION_2015.published)
    with pytest.raises(ValueError, match="does not hold the Inception network"):
        Inception.load(tmp_path)
