"""What patches are compared by."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from model.neuras.losses import gradient_loss, perceptual_loss
from tests.model.lpips import levels, write_weights

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("weights")
    write_weights(path, "vgg")
    return path


def patches(count: int, side: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(count * side * side, 3, generator=torch.Generator().manual_seed(seed))


def test_vgg_is_l1_between_layers_each_divided_by_its_elements(folder):
    truth, other = patches(2, 20), patches(2, 20, seed=1)
    found = perceptual_loss("vgg", folder, CPU)(other - truth, truth, 20).item()
    wanted = 0.0
    images = [x.view(2, 20, 20, 3).permute(0, 3, 1, 2).double().numpy() for x in (other, truth)]
    layers = [[list(levels(folder, "vgg", image)) for image in batch] for batch in images]
    for level in range(5):
        difference = np.array([layers[0][i][level] - layers[1][i][level] for i in range(2)])
        wanted += np.abs(difference).sum() / difference.size
    assert found == pytest.approx(wanted, rel=1e-4)


def test_vgg_passes_its_gradient_to_the_picture_alone(folder):
    loss, truth = perceptual_loss("vgg", folder, CPU), patches(1, 16)
    assert loss(torch.zeros_like(truth), truth, 16) == 0
    difference = (patches(1, 16, seed=1) - truth).requires_grad_()
    loss(difference, truth, 16).backward()
    assert difference.grad.abs().min() > 0
    assert not any(parameter.requires_grad for parameter in loss.features.parameters())


def test_the_stand_in_sees_edges_and_no_constant():
    flat = torch.full((64, 3), 0.3)
    assert gradient_loss(flat, flat, 8).item() == pytest.approx(0, abs=1e-6)
    edge = flat.view(8, 8, 3).clone()
    edge[:, 4:] += 1
    # at the three scales one of 7, 3 and 1 columns of differences is 1
    assert gradient_loss(edge.view(-1, 3), flat, 8).item() == pytest.approx(1 / 7 + 1 / 3 + 1, rel=1e-5)


def test_missing_weights_say_what_to_do(tmp_path):
    with pytest.raises(ValueError, match="vgg16.safetensors.*lightmill weights lpips.*perceptual_network=gradients"):
        perceptual_loss("vgg", tmp_path, CPU)
