"""Exposure as an affine change of colour per image."""

from __future__ import annotations

import numpy as np
import torch

from model.neuras.exposure import Exposure, halves, matched


def test_changes_average_to_none_and_are_each_images_own():
    exposure = Exposure(4)
    rgb, images = torch.rand(50, 3), torch.arange(50) % 4
    assert torch.equal(exposure(rgb, images), rgb)
    with torch.no_grad():
        exposure.change.normal_(0, 0.2)
    assert exposure.changes().mean(dim=0).abs().max() < 1e-6
    change = exposure.changes()[2].detach()
    of_it = images == 2
    expected = rgb[of_it] + rgb[of_it] @ change[:, :3].T + change[:, 3]
    assert torch.allclose(exposure(rgb, images)[of_it], expected, atol=1e-6)
    assert (exposure(rgb, images) - rgb).abs().max() > 0.05


def test_a_picture_takes_the_photos_exposure_where_it_is_told_to_look():
    picture = np.random.default_rng(0).integers(40, 180, (20, 30, 3)).astype(np.uint8)
    mixing = np.array([[0.8, 0.1, 0.0], [0.0, 1.1, 0.05], [0.1, 0.0, 0.9]])
    photo = np.round(picture @ mixing + [5, -3, 10]).astype(np.uint8)
    left, right = halves((20, 30))
    assert not (left & right).any() and (left | right).all() and left.mean() == 0.5
    photo[right] = 255 - photo[right]  # what is scored takes no part
    changed = matched(picture, photo, left)
    assert np.abs(changed[left].astype(int) - photo[left]).max() <= 1
    assert np.abs(changed[right].astype(int) - (255 - photo[right])).max() <= 1
