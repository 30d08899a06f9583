"""tokens: what a triangle's token holds, decoded to a texture of its outgoing diffuse radiance (paper, figure 7).

A small network (cross-attention to the registers, then an MLP) learns to turn a token into the texture of 32 x 32 texels
that the path tracer finds on that triangle, on scenes of one split, and is judged on another. The same network on the tokens
as they enter the view-independent stage says what that stage has added: those know the triangle and not its light. One
design choice: truth is traced at the texels themselves (``stages.renderformer.rendering.texels``), never read off an image.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import Field

from pipeline.config import count
from pipeline.errors import Reject, UserError
from pipeline.keys import seed_for
from pipeline.stage import Inputs, Item, Record
from stages.graphics.arrays import pack_arrays, unpack_arrays
from stages.graphics.tonemap import log_decode, log_encode
from stages.renderformer.probes.probe import Outcome, Probe, ProbeConfig, Worker
from stages.renderformer.records import SceneRecord

if TYPE_CHECKING:
    import torch

    from pipeline.store import Draft

SHOWN = 2  # scenes in the figure
SWATCHES = 8  # triangles of each that are shown as textures


class TokensConfig(ProbeConfig):
    name: Literal["tokens"] = "tokens"
    scenes: int = count(6, ge=1)
    fit_split: Literal["train", "validation", "test"] = "train"  # the decoder learns from these scenes ...
    fit_scenes: int = Field(64, ge=1)
    triangles: int = Field(32, ge=1)  # ... and of each from so many triangles, drawn by lot; of a held-out one, from all seen
    size: int = Field(32, ge=4, le=64)  # texels along a triangle's legs
    spp: int = Field(32, ge=1)  # samples per texel
    steps: int = Field(400, ge=10)  # the first tenth warms up
    batch: int = Field(256, ge=1)  # triangles per step
    width: int = Field(512, ge=8)  # of the MLP
    lr: float = Field(1e-3, gt=0)
    drawn_px: int = Field(192, ge=16, le=2048)  # of the pictures that textures are drawn on


class Tokens(Probe):
    name = "tokens"
    title = "What triangle tokens hold"
    question = "Can a triangle's own light be read from its token, before a camera is known?"
    setting = "decoded from"
    Config = TokensConfig

    def refusal(self, model: Any) -> str | None:
        if not model.reads_guides:
            return None
        return "a guided model is given each triangle's light in closed form, so that its tokens say nothing of what it learned"

    def items(self, config: TokensConfig, inputs: Inputs) -> Iterator[Item]:
        if config.fit_split == config.split:
            raise UserError(f"probe.fit_split and probe.split are both {config.split}: what is fitted must not judge")
        fit = inputs["shard"].ids(config.fit_split)[: config.fit_scenes]
        if not fit:
            raise UserError(f"probe.fit_split={config.fit_split}: the shards hold no such scene to fit the decoder on")
        yield from (Item(id, config.fit_split) for id in fit)
        yield from (Item(id, config.split) for id in self.scene_ids(config, inputs))

    def process(self, worker: Worker, item: Item) -> Iterator[Record]:
        """Truth: log10(1 + radiance) at the texels of some triangles."""
        from stages.renderformer.rendering.texels import texel_radiance

        config, scene = worker.config, worker.base(item.id)
        arrays = {}
        if item.group == config.split:
            arrays["seen"] = worker.trace(
                scene, resolution=config.drawn_px, max_spp=1, target_error=0.0, denoise=False
            ).triangle
            faces = np.unique(arrays["seen"][arrays["seen"] >= 0])
        else:
            faces = worker.rng("tokens", item.id).permutation(len(scene.triangles))
        faces = faces[scene.light_index[faces] < 0]
        if not len(faces):
            raise Reject("dark", "the camera sees nothing that reflects")
        faces = faces if item.group == config.split else np.sort(faces[: config.triangles])
        seed = seed_for(config.seed, "probe/tokens", item.id)
        radiance, met = texel_radiance(scene, faces, spp=config.spp, seed=seed, backend=worker.renderer, size=config.size)
        arrays |= {"faces": faces.astype(np.int32), "met": met}
        arrays["radiance"] = log_encode(radiance.sum(axis=1)).astype(np.float16)  # over lights
        yield Record(item.id, {"texels.npz": pack_arrays(arrays, compressed=True)})

    def finish(self, worker: Worker, draft: Draft) -> Outcome:
        from stages.graphics.metrics import METRICS
        from stages.graphics.statistics import bootstrap, with_interval
        from stages.renderformer.probes.decoder import decode, fit_decoder

        config = worker.config
        truth = {row.id: unpack_arrays(draft.read(row.id).members["texels.npz"]) for row in draft.rows()}
        scenes = {id: worker.base(id) for id in truth}
        fit_ids, test_ids = draft.ids(config.fit_split), draft.ids(config.split)
        tokens = {id: tokens_of(worker.model, scene, worker.device) for id, scene in scenes.items()}
        decoded: dict[str, dict[str, np.ndarray]] = {}
        for stage, name in enumerate(("tokens that enter the encoder", "tokens that leave it")):
            decoder = fit_decoder([(*tokens[id][stage], truth[id]) for id in fit_ids], config)
            decoded[name] = {id: decode(decoder, *tokens[id][stage], truth[id]["faces"], config.size) for id in test_ids}
        every = np.concatenate([truth[id]["radiance"][truth[id]["met"]] for id in fit_ids]).astype(np.float32)
        grey = np.median(every, axis=0)
        decoded["nothing: the colour that fits all best"] = {
            id: np.broadcast_to(grey, truth[id]["radiance"].shape) for id in test_ids
        }
        decoded["the truth: each triangle's own mean"] = {
            id: np.broadcast_to(means(truth[id]["radiance"], truth[id]["met"]), truth[id]["radiance"].shape) for id in test_ids
        }
        rows = []
        for name, by_scene in decoded.items():
            errors = {id: errors_of(by_scene[id], truth[id]["radiance"], truth[id]["met"]) for id in test_ids}
            estimates = [bootstrap([[errors[id][part]] for id in test_ids], METRICS["log_error"].bounds) for part in range(3)]
            rows.append([name, *(with_interval(value, "{:.4f}".format) for value in estimates)])
        columns = [self.setting, "log error of texels", "of triangles' means", "of what varies within triangles"]
        fitted, judged = (sum(int(truth[id]["met"].any(axis=(1, 2)).sum()) for id in ids) for ids in (fit_ids, test_ids))
        notes = [
            f"Decoder fitted to {fitted:,} triangles of {len(fit_ids)} {config.fit_split} scenes in {config.steps} steps, "
            f"judged on {judged:,} triangles of {len(test_ids)} {config.split} scenes, {config.size} x {config.size} texels at "
            f"{config.spp} samples each; 95 % intervals over scenes.",
            "Error: mean absolute difference of log10(1 + radiance), of the diffuse part that leaves a triangle's front. "
            "Tokens that enter the encoder know shape, place and material of their own triangle only.",
            "Below the pictures: triangles that vary most within themselves among the larger ones in the picture, each with an "
            "exposure of its own; grey where something covers the surface.",
        ]
        if not worker.model.config.num_layers:
            notes.append("This network has no view-independent layers: both kinds of token are the same.")
        figure = self._figure(config, worker, draft, test_ids[:SHOWN], scenes, truth, decoded)
        return Outcome(columns, rows, figure, notes)

    def _figure(
        self, config: TokensConfig, worker: Worker, draft: Draft, ids: list[str], scenes: dict[str, SceneRecord],
        truth: dict[str, Any], decoded: dict[str, dict[str, np.ndarray]],
    ) -> Any:  # fmt: skip
        from stages.graphics.tonemap import exposure_for, to_picture
        from stages.renderformer.probes.decoder import kept_texels
        from stages.renderformer.probes.figures import WIDTH, new_figure, show_picture

        names, kept = list(decoded)[:2], kept_texels(config.size)
        titles = ["path traced picture", "truth at the texels", *(f"decoded from\n{name}" for name in names)]
        side = (WIDTH - 0.2) / len(titles)
        small = (WIDTH - 0.6) / (SWATCHES + 1)
        figure = new_figure(len(ids) * (side + 3 * small + 0.75))
        outer = figure.add_gridspec(2 * len(ids), 1, height_ratios=[side + 0.3, 3 * small + 0.3] * len(ids))
        for number, id in enumerate(ids):
            texels, scene = truth[id], scenes[id]
            sheets = [log_decode(texels["radiance"].astype(np.float32)), *(log_decode(decoded[name][id]) for name in names)]
            sheets = [np.where(texels["met"][..., None], sheet, 0) for sheet in sheets]
            drawn = [draw_textures(scene, texels["seen"], texels["faces"], sheet) for sheet in sheets]
            exposure = exposure_for(drawn[0])
            picture = worker.trace(scene, resolution=config.drawn_px).image
            top = outer[2 * number].subgridspec(1, len(titles))
            for column, image in enumerate([picture, *drawn]):
                axes = figure.add_subplot(top[column])
                show_picture(axes, to_picture(image, exposure), titles[column] if number == 0 else "")
            # triangles that vary most within themselves among those that are large in the picture
            pixels = np.array([(texels["seen"] == face).sum() for face in texels["faces"]])
            uncovered = texels["met"].sum(axis=(1, 2)) >= 0.9 * texels["met"].sum(axis=(1, 2)).max()
            spread = np.where(texels["met"], texels["radiance"].astype(np.float32).mean(axis=-1), np.nan)
            large = np.flatnonzero(uncovered & (pixels >= np.percentile(pixels[uncovered], 50)))
            order = large[np.argsort(-np.nan_to_num(np.nanstd(spread[large], axis=(1, 2))), kind="stable")][:SWATCHES]
            below = outer[2 * number + 1].subgridspec(3, SWATCHES)
            for column, face in enumerate(order):
                brightest = exposure_for(sheets[0][face][texels["met"][face]])
                for row, (sheet, name) in enumerate(zip(sheets, ("truth", "entering", "leaving"), strict=True)):
                    swatch = to_picture(sheet[face], brightest)
                    swatch[kept & ~texels["met"][face]] = 205
                    swatch[~kept] = 255
                    show_picture(figure.add_subplot(below[row, column]), swatch, row="" if column else name)
        return figure


# --- tokens and textures ----------------------------------------------------------------------------------------------


def tokens_of(model: Any, scene: SceneRecord, device: str) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """The scene's (registers (R, d), triangles (F, d)) as they enter and as they leave the view-independent layers."""
    import torch

    from stages.renderformer.dataset import collate, make_example
    from stages.renderformer.dataset.shards import Sample

    entering: list[torch.Tensor] = []
    hook = model.transformer.register_forward_pre_hook(lambda layer, inputs: entering.append(inputs[0]))
    batch = collate([make_example(Sample(scene, {}), np.zeros(0, np.int64), None)], 1)
    try:
        with torch.no_grad():
            leaving = model.encode(model.read(batch, device)).x
    finally:
        hook.remove()
    registers = model.config.num_register_tokens
    return [(x[:registers].float().cpu(), x[registers:].float().cpu()) for x in (entering[0], leaving)]


def means(radiance: np.ndarray, met: np.ndarray) -> np.ndarray:
    """(T, 1, 1, 3) mean over the texels that were met, of (T, P, P, 3) and (T, P, P)."""
    weights = met[..., None].astype(np.float32)
    return (radiance * weights).sum(axis=(1, 2), keepdims=True) / np.maximum(weights.sum(axis=(1, 2), keepdims=True), 1)


def errors_of(predicted: np.ndarray, truth: np.ndarray, met: np.ndarray) -> tuple[float, float, float]:
    """Mean absolute error of (T, P, P, 3) log radiance: of texels, of triangles' means, and of what is left of both
    without their means. Every texel weighs the same, and so every triangle by its texels."""
    predicted, truth = predicted.astype(np.float32), truth.astype(np.float32)
    a, b, counts = means(predicted, met), means(truth, met), met.sum(axis=(1, 2))
    of_means = np.average(np.abs(a - b).mean(axis=(1, 2, 3)), weights=counts)
    within = np.abs((predicted - a) - (truth - b))[met].mean()
    return tuple(float(x) for x in (np.abs(predicted - truth)[met].mean(), of_means, within))


def draw_textures(scene: SceneRecord, triangle_at_pixel: np.ndarray, faces: np.ndarray, textures: np.ndarray) -> np.ndarray:
    """(H, W, 3) picture of the textures (T, P, P, 3) of triangles ``faces`` as the scene's first camera sees them.

    triangle_at_pixel: (H, W), -1 for nothing. The picture is black where a triangle shows its back or has no texture.
    """
    import torch

    from model.renderformer.network import ray_directions

    side, size = len(triangle_at_pixel), textures.shape[1]
    pose = scene.camera_to_world[0].astype(np.float64)
    directions = ray_directions(torch.tensor(float(scene.fov_deg[0])), side, side).numpy().astype(np.float64) @ pose[:3, :3].T
    row_of = np.full(len(scene.triangles) + 1, -1)
    row_of[faces] = np.arange(len(faces))
    y, x = np.nonzero((triangle_at_pixel >= 0) & (row_of[triangle_at_pixel] >= 0))
    corners, ray = scene.triangles[triangle_at_pixel[y, x]].astype(np.float64), directions[y, x]
    # p + t d = a + u (b - a) + v (c - a), solved for (t, u, v)
    a, ab, ac = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    front = np.einsum("ni,ni->n", np.cross(ab, ac), ray) < 0
    system = np.stack([-ray, ab, ac], axis=2)[front]
    u, v = np.linalg.solve(system, (pose[:3, 3] - a)[front][..., None])[:, 1:, 0].T.clip(0, 1)
    y, x = y[front], x[front]
    column, row = ((w * size).astype(int).clip(0, size - 1) for w in (u, v))
    over = np.maximum(row + column - size, 0)  # beside the triangle, where the pixel's sample met it and its centre does not
    out = np.zeros((side, side, 3), np.float32)
    out[y, x] = textures[row_of[triangle_at_pixel[y, x]], np.maximum(row - over, 0), column]
    return out


PROBES: tuple[type[Probe], ...] = (Tokens,)
