"""Stage fit: textures, skyboxes, codebooks and both networks, learned once per scene (sections 3.1 to 3.3).

Reads capture's training and validation frames and the atlas; writes ``model.safetensors`` and ``model.json`` (``Baked``),
``poses.json`` (of the cameras that *refine* moved), ``curve.csv`` and ``curve.png``, ``validation/`` (truth above,
ours below) and ``tensorboard/``. What each pixel sees of the mesh is cast anew in a run that goes on: 0.05 CPU-s a frame.
The loop is ``model.neuras.fitting.fit``.
"""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import Field, model_validator

from pipeline.config import StageConfig, added, runtime
from pipeline.errors import UserError
from pipeline.stage import Inputs, RunStage
from stages.graphics.device import choose_device

if TYPE_CHECKING:
    import numpy as np

    from model.neuras.fitting import Surroundings
    from model.neuras.rays import View
    from model.neuras.scene import FitConfig
    from pipeline.store import Draft
    from stages.graphics.cameras import Camera
    from stages.neuras.records import AtlasMesh, CaptureInfo, FrameRecord

VGG_LEAST = 16  # pixels along a patch: VGG16 halves it four times
SKY_STEP, SKY_MOST = 64, 512  # texels: a face spans two focal lengths, and a device keeps 36 faces
BYTES = 37  # of what a pixel sees
REACH = 3.0  # texels of a level around a chart that a sample may read


class FitStageConfig(StageConfig):
    """Lengths end in ``_m``: metres, or nominal metres where the capture's unit is unknown (``CaptureInfo.metre``)."""

    seed: int = 0
    # Features and networks
    channels: int = Field(12, ge=4, le=64)  # D
    hidden: int = Field(32, ge=8, le=256)  # units of a layer
    layers: int = Field(3, ge=0, le=6)  # 0: a feature's first three channels are the colour
    view_direction: bool = True  # the networks read it
    codes: int = Field(1024, ge=0, le=65536)  # K of each codebook; 0: no quantization
    skyboxes: int = Field(6, ge=1, le=16)  # L
    texture_levels: int = Field(3, ge=1, le=5)  # of the mesh's texture, each half as wide and high; 1: the paper's
    sky_side: int | None = Field(None, ge=8, le=8192)  # texels along a face of a skybox; null: one per two pixels, at most 512
    sky_near_m: float = Field(150.0, gt=0)  # half size of the nearest skybox
    sky_far_m: float = Field(2400.0, gt=0)
    rays: int = Field(2, ge=1, le=8)  # along a pixel's side, whose mean is drawn: edges are smooth
    # Optimization
    steps: int = Field(1500, ge=1)
    patch: int = Field(8, ge=2)  # pixels along a patch
    patches: int = Field(128, ge=1)  # of a step
    lr: float = Field(0.003, gt=0)  # of textures and codes
    network_lr: float = Field(0.003, gt=0)
    final_lr: float = Field(0.1, ge=0, le=1)  # share of both at the end of the cosine
    vq: float = Field(0.1, ge=0)  # lambda_vq
    commitment: float = Field(0.25, ge=0)  # beta
    quantize_from: float = Field(0.0, ge=0, le=1)  # share of the steps before quantization begins
    perceptual: float = Field(0.0, ge=0)  # lambda_perc
    perceptual_network: Literal["gradients", "vgg"] = added("gradients", legacy="gradients")  # what it compares
    shared_levels: int = Field(2, ge=0, le=4)  # coarse levels that near texels share
    voxel_m: float = Field(0.3, gt=0)  # edge of the finest cell of the mesh; each coarser one is four times as wide
    block: int = Field(4, ge=2)  # texels along the finest cell of a skybox
    near_opacity: float = Field(0.12, gt=0, lt=1)  # of all skyboxes but the farthest, at the start
    direction_noise: float = Field(0.0, ge=0)  # sigma added to the view direction
    coarser_share: float = Field(0.15, ge=0, lt=1)  # of the pixels that read coarser levels than they ask for
    exposure: bool = added(False, legacy=False)  # an affine change of colour per training image
    # Runtime
    device: str = runtime("auto")  # auto | cpu | cuda
    threads: int | None = runtime(1, ge=1)  # CPU threads; null: torch's choice
    compile: bool = runtime(False)  # torch.compile
    mixed_precision: bool = runtime(False)  # networks in bfloat16, on a GPU
    log_every: int = runtime(50, ge=1)  # steps
    validate_every: int = runtime(0, ge=0)  # steps; 0: at the end alone
    checkpoint_every: int = runtime(100, ge=1)
    pictures: int = runtime(6, ge=0)  # validation views shown
    tensorboard: bool = runtime(True)  # events besides the curve
    lpips_folder: str | None = runtime(None)  # where VGG16's weights lie; None: see model.weights

    @model_validator(mode="after")
    def _consistent(self) -> FitStageConfig:
        if self.layers == 1:
            raise ValueError("layers=1 leaves no layer before the opacity: 0 for no network, or at least 2")
        if self.sky_far_m < self.sky_near_m:
            raise ValueError(f"sky_far_m={self.sky_far_m:g} is less than sky_near_m={self.sky_near_m:g}")
        if self.perceptual_network == "vgg":
            if not self.perceptual:
                raise ValueError(
                    "perceptual_network=vgg does nothing with perceptual=0: give it a weight, such as perceptual=0.001"
                )
            if self.patch < VGG_LEAST:
                raise ValueError(
                    f"patch={self.patch} is too small for VGG16, which needs {VGG_LEAST} pixels: better patch=32 patches=8"
                )
        return self

    def fit(self, metre: float, focal: float) -> FitConfig:
        """The loop's part: the fields of the same names, lengths in world units. focal: of the photos, in pixels."""
        import dataclasses

        from model.neuras.scene import FitConfig, ShaderConfig

        def those_of(kind: Any) -> dict[str, Any]:
            return {f.name: getattr(self, f.name) for f in dataclasses.fields(kind) if f.name in type(self).model_fields}

        side = min(max(round(focal / SKY_STEP), 1) * SKY_STEP, SKY_MOST) if self.sky_side is None else self.sky_side
        fields = those_of(FitConfig) | {"sky_side": side, "voxel": self.voxel_m * metre}
        return FitConfig(shader=ShaderConfig(**those_of(ShaderConfig)), **fields)


class Fit(RunStage):
    name: ClassVar[str] = "fit"
    version: ClassVar[int] = 5
    inputs: ClassVar[dict[str, str]] = {"capture": "capture", "scaffold": "refine", "atlas": "atlas"}
    Config: ClassVar[Any] = FitStageConfig

    def slug(self, config: FitStageConfig) -> str:
        parts = ["plain" if not config.layers else "" if config.view_direction else "fixed", "" if config.codes else "novq"]
        return "-".join(part for part in parts if part) or f"{config.steps}"

    def identity(self, config: FitStageConfig, hash_file: Callable[[Any], str]) -> dict[str, Any]:
        """VGG16's weights, where the loss reads them."""
        from model.neuras.losses import vgg_file

        return {"vgg16": hash_file(vgg_file(config.lpips_folder))} if config.perceptual_network == "vgg" else {}

    def run(self, config: FitStageConfig, inputs: Inputs, draft: Draft) -> list[str]:
        import torch

        from model.neuras.fitting import Outputs, fit
        from stages.graphics.casting import Caster
        from stages.neuras.records import POSES, CaptureInfo, frames, load_atlas, posed, refined_poses, save_poses

        if config.threads is not None:
            torch.set_num_threads(config.threads)
        torch.set_flush_denormal(True)
        info = CaptureInfo.of(inputs["capture"])
        atlas = load_atlas(inputs["atlas"].file("atlas.npz"))
        caster = Caster(atlas.vertices, atlas.faces)
        poses = refined_poses(inputs["scaffold"])
        device = choose_device(config.device, "fit.device")
        photos, held_out = (list(posed(frames(inputs["capture"], split), poses)) for split in ("train", "validation"))
        _check_memory([photo.camera for photo in photos + held_out], device == "cpu")
        training, validation = ([_view(frame, atlas, caster) for frame in part] for part in (photos, held_out))
        if not training:
            raise UserError("the capture has no training frame: look at its split")
        outputs = Outputs(
            state=draft.state,
            say=draft.log,
            show=lambda step, truths, ours: _show(draft.files / "validation", step, truths, ours, config.pictures),
            tensorboard=draft.files / "tensorboard" if config.tensorboard else None,
        )
        surroundings = _surroundings(config, info, atlas, [view.origin for view in training + validation])
        fitting = config.fit(info.metre, focal_length(photos))
        baked, summary = fit(fitting, surroundings, training, validation, outputs, device)
        baked.save(draft.files)
        save_poses(draft.files, poses)
        rows = [json.loads(line) for line in (draft.state / "log.jsonl").read_text().splitlines()]
        _write_curve(rows, draft.files)
        draft.note("fitting", summary)
        return ["model.json", "model.safetensors", POSES]


def _check_memory(cameras: Sequence[Camera], on_cpu: bool) -> None:
    """UserError where what the photos' pixels see does not fit into this machine's free memory: once by photo, and in a row,
    on the device.
    """
    import psutil

    needed = BYTES * (2 if on_cpu else 1) * sum(camera.width * camera.height for camera in cameras)
    free = psutil.virtual_memory().available
    if needed > free:
        raise UserError(
            f"{len(cameras)} photos of up to {max(camera.width for camera in cameras)} pixels' width take about "
            f"{needed / 1e9:.0f} GB of memory, and {free / 1e9:.0f} GB are free: make them smaller (capture.max_side=1280), or "
            "take fewer (capture.every=2)"
        )


def focal_length(photos: Iterable[FrameRecord]) -> float:
    """The median, in pixels."""
    return statistics.median(photo.camera.fx for photo in photos)


def _view(frame: FrameRecord, atlas: AtlasMesh, caster: Any) -> View:
    """What the frame's pixels see of the mesh, and their colours."""
    import numpy as np

    from model.neuras.rays import View
    from stages.neuras.rasterizing.footprints import footprint

    seen = caster.view(frame.camera)
    return View(
        origin=frame.camera.position,
        **vars(footprint(seen, frame.camera, atlas)),
        directions=frame.camera.directions().astype(np.float32),
        uv=seen.interpolate(atlas.faces, atlas.uvs),
        hit=seen.hit,
        rgb=frame.image(),
        counts=frame.counts(),
    )


def _surroundings(config: FitStageConfig, info: CaptureInfo, atlas: AtlasMesh, cameras: list[np.ndarray]) -> Surroundings:
    """Where texels lie in the world, and the skyboxes around the box of mesh and cameras."""
    import numpy as np

    from model.errors import InputError
    from model.neuras.sampling import Pyramid
    from model.neuras.scene import Surroundings
    from model.neuras.skyboxes import half_sizes
    from stages.neuras.rasterizing.texels import sheet

    try:
        pyramid = Pyramid(atlas.width, atlas.height, config.texture_levels)
    except InputError as error:
        raise UserError(f"{error}; set fit.texture_levels=1, or another atlas.size") from None
    positions, inside = sheet(atlas, pyramid, REACH)
    everything = np.concatenate([atlas.vertices, np.array(cameras)])
    low, high = everything.min(axis=0), everything.max(axis=0)
    near, far = config.sky_near_m * info.metre, config.sky_far_m * info.metre
    return Surroundings(
        pyramid=pyramid,
        positions=positions,
        inside=inside,
        sky_centre=((low + high) / 2).astype(np.float64),
        sky_half_sizes=half_sizes((high - low) / 2, near, far, config.skyboxes),
    )


def _show(folder: Path, step: int, truths: list[np.ndarray], ours: list[np.ndarray], count: int) -> np.ndarray:
    """The first ``count`` views side by side, truth above; also written as ``step-<step>.png``."""
    import numpy as np
    from PIL import Image

    height, width = truths[0].shape[:2]
    columns = [
        np.concatenate([truth, np.round(255 * image).astype(np.uint8)])
        for truth, image in zip(truths, ours, strict=True)
        if truth.shape[:2] == (height, width)
    ]
    picture = np.concatenate(columns[: max(count, 1)], axis=1)
    if count:
        folder.mkdir(parents=True, exist_ok=True)
        Image.fromarray(picture).save(folder / f"step-{step:07}.png")
    return picture


def _write_curve(rows: Iterable[dict[str, Any]], folder: Path) -> None:
    """``curve.csv``, a line per row of the log, and ``curve.png``: loss on the left, validation PSNR on the right."""
    import csv

    from matplotlib.figure import Figure

    rows = list(rows)
    names = ["step", *sorted({name for row in rows for name in row} - {"step"})]
    with (folder / "curve.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, names, restval="")
        writer.writeheader()
        writer.writerows(rows)
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.add_subplot()
    right = axes.twinx()
    for where, name, label, style in (
        (axes, "photometric", "photometric loss", "C0-"),
        (axes, "vq", "quantization loss", "C1-"),
        (right, "validation_psnr", "validation PSNR", "C2o--"),
    ):
        points = [(row["step"], row[name]) for row in rows if row.get(name)]
        if points:
            where.plot(*zip(*points, strict=True), style, label=label, linewidth=1.2, markersize=3)
    axes.set(xlabel="step", ylabel="mean squared error", yscale="log")
    right.set(ylabel="PSNR (dB)")
    axes.grid(alpha=0.3, which="both")
    figure.legend(loc="outside lower center", ncols=3, frameon=False)
    figure.savefig(folder / "curve.png", dpi=120)
