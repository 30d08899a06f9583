"""Render scenes with a trained network: what ``lightmill predict`` and *evaluate* call.

Reads a scene file or record and a released-format checkpoint folder; returns or writes linear HDR images. The scene is
encoded once and all its views are decoded from the same tokens (section 3.1).
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import UserError

if TYPE_CHECKING:
    from model.renderformer import RenderFormer
    from stages.records import SceneRecord

RELEASED_TRIANGLES = 4096  # most triangles of the released training data, for checkpoints that do not say (section 2)


PRETRAINED = Path(__file__).resolve().parents[1] / "model" / "pretrained"  # the checkpoint that ships, if one does


def shipped_checkpoint() -> Path:
    """The folder of the model that ships with the project."""
    if not (PRETRAINED / "config.json").is_file():
        raise UserError(
            "no model ships with this version: train one (`make train`) and give --checkpoint train, or give "
            "--checkpoint FOLDER with a released checkpoint (config.json, model.safetensors)"
        )
    return PRETRAINED


def load_model(folder: Path) -> RenderFormer:
    """The network of a released-format checkpoint folder, in eval mode on the CPU."""
    from model import checkpoint

    return checkpoint.load(folder)[0]


def predict_scene(
    model: RenderFormer, scene: SceneRecord, views: Sequence[int], resolution: int, device: Any = "cpu"
) -> np.ndarray:
    """(V, H, W, 3) float32 linear radiance of the scene's cameras ``views``, at least 0."""
    import torch

    from model.renderformer import to_radiance

    arrays = scene.arrays()
    patches = arrays.pop("patches", None)
    batch = {name: array[None] for name, array in arrays.items()} | {"mask": np.ones((1, len(scene.triangles)), bool)}
    if patches is not None:
        batch["patches"] = patches
    model = model.to(device).eval()
    cameras = torch.from_numpy(scene.camera_to_world[list(views)].astype(np.float32)).to(device)[None]
    fov = torch.from_numpy(scene.fov_deg[list(views)].astype(np.float32)).to(device)[None]
    y = model.render(model.read(batch, device), cameras, fov, resolution)[0]
    return to_radiance(y).clamp(min=0).cpu().numpy()  # the network may undershoot 0 by a thousandth


def predict(
    scene_path: Path, checkpoint_folder: Path, out: Path, resolution: int = 512, view: int | str = 0, device: str = "auto"
) -> list[Path]:
    """Render a scene file with a checkpoint; returns the images written (``OUT-0.exr``, ... for ``view="all"``).

    .exr holds linear radiance, .png sRGB of radiance clamped to [0, 1].
    """
    from model import checkpoint
    from stages.device import choose_device
    from stages.exr import write_rgb
    from stages.released import load_scene

    if out.suffix.lower() not in (".exr", ".png"):
        raise UserError(f"{out}: the output must end in .exr (linear) or .png")
    scene = load_scene(scene_path)
    count = len(scene.fov_deg)
    if view != "all" and not (isinstance(view, int) and 0 <= view < count):
        raise UserError(f"view {view} of {scene_path} does not exist: it has cameras 0 to {count - 1}, or say all")
    model, trained_with = checkpoint.load(checkpoint_folder)
    multiple = model.config.resolution_multiple
    if resolution < multiple or resolution % multiple:
        raise UserError(f"resolution {resolution} must be a multiple of {multiple} pixels for this checkpoint")
    limit = int(trained_with.get("triangles", RELEASED_TRIANGLES))
    if len(scene.triangles) > limit:
        print(
            f"warning: {scene_path} has {len(scene.triangles):,} triangles, the checkpoint was trained with at most "
            f"{limit:,}: expect worse images",
            file=sys.stderr,
        )
    views = list(range(count)) if view == "all" else [int(view)]
    images = predict_scene(model, scene, views, resolution, choose_device(device, "--device"))
    written = []
    for index, image in zip(views, images, strict=True):
        path = out.with_name(f"{out.stem}-{index}{out.suffix}") if view == "all" else out
        if path.suffix.lower() == ".exr":
            write_rgb(path, image)
        else:
            _write_png(path, image)
        written.append(path)
    return written


def _write_png(path: Path, image: np.ndarray) -> None:
    """The picture appears whole or not at all."""
    from PIL import Image

    from stages.tonemap import to_picture

    temporary = path.with_name(path.name + ".tmp")
    try:
        Image.fromarray(to_picture(image)).save(temporary, format="png")
        temporary.replace(path)
    except OSError as error:
        raise UserError(f"{path} cannot be written ({error}): give a file in an existing folder") from error
