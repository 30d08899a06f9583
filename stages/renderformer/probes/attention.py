"""attention: what a ray bundle looks at, drawn on the triangles (paper, figure 8).

For a few ray bundles of a view, the cross-attention weights over the triangle tokens, layer by layer, averaged over the
heads: of RenderFormer's view-dependent layers, or of the one in which a guided model's bundles gather. One design choice: the
weights are computed beside the network, from what its layers are given (forward hooks), so that the fast path knows nothing of
them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import Field

from pipeline.config import count
from pipeline.stage import Inputs, Item, Record
from stages.graphics.arrays import pack_arrays, pack_json, unpack_arrays, unpack_json
from stages.renderformer.probes.probe import Outcome, Probe, ProbeConfig, Worker
from stages.renderformer.records import SceneRecord

if TYPE_CHECKING:
    from pipeline.store import Draft

SHOWN = 2  # scenes in the figure
MOST_LAYERS = 6  # columns of the figure; of more layers, evenly spaced ones


class AttentionConfig(ProbeConfig):
    name: Literal["attention"] = "attention"
    scenes: int = count(2, ge=1)
    bundles: int = Field(3, ge=1, le=6)  # ray bundles per view
    drawn_px: int = Field(192, ge=16, le=2048)  # of the pictures that weights are drawn on


def cross_attention(model: Any, scene: SceneRecord, resolution: int | tuple[int, int], device: str = "cpu") -> np.ndarray:
    """(layers, rays, tokens) float32 weights, averaged over heads, of the scene's first camera: registers come first.

    A row sums to 1.
    """
    import torch

    from model.renderformer.layers import rotate, split_heads
    from stages.renderformer.inference.predict import network_arrays

    layer_weights: list[torch.Tensor] = []

    def look(layer: Any, inputs: tuple) -> None:
        x, tokens, key_rotation, ray_rotation = inputs[:4]
        cross = layer.multihead_attn
        keys = layer.keys_values(tokens)[0] if isinstance(tokens, torch.Tensor) else tokens[0]
        query = rotate(split_heads(cross.q_norm(cross.q_proj(layer.query_norm(x))), cross.heads), ray_rotation)
        keys = rotate(keys, key_rotation)
        weights = (query @ keys.transpose(-1, -2) / query.shape[-1] ** 0.5).softmax(dim=-1)
        layer_weights.append(weights.mean(dim=1)[0].float().cpu())

    size = (resolution, resolution) if isinstance(resolution, int) else resolution
    batch, seen_by = network_arrays(model, scene, size)
    image = np.broadcast_to(np.float32(0), (1, 1, *size, 3))  # whose size alone is read
    hooks = [layer.register_forward_pre_hook(look) for layer in model.gathering_layers()]
    try:
        with torch.inference_mode():
            model.to(device).eval()(*model.arguments({**batch, **seen_by(0), "image": image}, device))
    finally:
        for hook in hooks:
            hook.remove()
    return torch.stack(layer_weights).numpy()


def choose_bundles(triangle: np.ndarray, object_index: np.ndarray, number: int, patch: int) -> list[int]:
    """Which ray bundles (row-major) to look at: one of each of the objects that are seen most, near its middle.

    triangle: (H, W) int32 seen by each pixel, -1 for nothing. object_index: (F,).
    """
    side = len(triangle) // patch
    object_at_pixel = np.where(triangle >= 0, object_index[triangle], -1)
    tiles = object_at_pixel.reshape(side, patch, side, patch).swapaxes(1, 2).reshape(side * side, -1)
    names, pixels = np.unique(object_at_pixel[object_at_pixel >= 0], return_counts=True)
    places = np.stack(np.divmod(np.arange(side * side), side), axis=1)
    chosen: list[int] = []
    for name in names[np.argsort(-pixels, kind="stable")]:
        share = (tiles == name).mean(axis=1)
        full = np.flatnonzero(share >= 0.75 * share.max())
        middle = np.average(places, axis=0, weights=share)
        best = int(full[np.linalg.norm(places[full] - middle, axis=1).argmin()])
        if best not in chosen:
            chosen.append(best)
    fullest = np.argsort(-(tiles >= 0).mean(axis=1), kind="stable")
    chosen += [int(tile) for tile in fullest[:: max(1, len(fullest) // (4 * number))] if int(tile) not in chosen]
    return chosen[:number]


class Attention(Probe):
    name = "attention"
    title = "Attention of a ray bundle"
    question = "Which triangles does a ray bundle look at, layer by layer?"
    setting = "ray bundle and layer"
    Config = AttentionConfig

    def refusal(self, model: Any) -> str | None:
        if model.gathering_layers():
            return None
        return "ray bundles of this model look at no triangles (model.tokens=encoder gives it the attention)"

    def items(self, config: AttentionConfig, inputs: Inputs) -> Iterator[Item]:
        for scene_id in self.scene_ids(config, inputs):
            yield Item(scene_id, config.split)

    def process(self, worker: Worker, item: Item) -> Iterator[Record]:
        from stages.graphics.exr import encode_rgb

        config, scene = worker.config, worker.base(item.id)
        prediction = worker.predict(scene)  # first: it says what is wrong with a resolution
        view = worker.trace(scene)
        drawn = worker.trace(scene, resolution=config.drawn_px, max_spp=1, target_error=0.0, denoise=False).triangle
        patch = worker.model.config.bundle_side
        bundles = choose_bundles(view.triangle, scene.object_index, config.bundles, patch)
        weights = cross_attention(worker.model, scene, config.resolution, worker.device)[:, bundles]
        registers = worker.model.config.registers
        side = config.resolution // patch
        tiles = view.triangle.reshape(side, patch, side, patch).swapaxes(1, 2).reshape(side * side, -1)
        lit = scene.light_index >= 0
        weight_rows = []
        for number, bundle in enumerate(bundles):
            bundle_triangles = np.unique(tiles[bundle])
            bundle_triangles = bundle_triangles[bundle_triangles >= 0]
            objects = scene.object_index[tiles[bundle][tiles[bundle] >= 0]]
            on_object = scene.meta["objects"][np.bincount(objects).argmax()]["name"] if len(objects) else "nothing"
            for layer, row in enumerate(weights[:, number]):
                on = row[registers:]
                weight_rows.append(
                    {
                        "bundle": number,
                        "on": on_object,  # what most of its pixels see
                        "layer": layer,
                        "registers": float(row[:registers].sum()),
                        "own": float(on[bundle_triangles].sum()),
                        "lights": float(on[lit].sum()),
                        "effective": float(np.exp(-np.sum(row * np.log(np.maximum(row, 1e-12))))),
                    }
                )
        facts = {"scene": item.id, "bundles": bundles, "triangles": len(scene.triangles), "weights": weight_rows}
        arrays = {"weights": weights[:, :, registers:].astype(np.float32), "triangle": drawn.astype(np.int32)}
        members = {"reference.exr": encode_rgb(view.image), "prediction.exr": encode_rgb(prediction)}
        yield Record(
            item.id, {"metrics.json": pack_json(facts), "weights.npz": pack_arrays(arrays, compressed=True), **members}
        )

    def finish(self, worker: Worker, draft: Draft) -> Outcome:
        ids = [row.id for row in draft.rows()]
        facts = [unpack_json(draft.read(id, ("metrics.json",)).members["metrics.json"]) for id in ids]
        figure = self._figure(worker, [draft.read(id) for id in ids[:SHOWN]], facts)
        registers = worker.model.config.registers
        columns = ["layer", "on registers %", "on the bundle's own triangles %", "on lights %", "effective number of tokens"]
        rows = []
        for layer in range(len(worker.model.gathering_layers())):
            of_layer = [row for fact in facts for row in fact["weights"] if row["layer"] == layer]
            means = {name: np.mean([row[name] for row in of_layer]) for name in ("registers", "own", "lights", "effective")}
            shares = [f"{100 * means[name]:.1f}" for name in ("registers", "own", "lights")]
            rows.append([str(layer + 1), *shares, f"{means['effective']:.0f}"])
        triangles = np.mean([fact["triangles"] for fact in facts])
        side = worker.model.config.bundle_side
        notes = [
            f"{len(facts)} scene(s), {sum(len(fact['bundles']) for fact in facts)} ray bundles; weights averaged over heads. "
            f"A scene has {triangles:,.0f} triangles on average and {registers} registers"
            + (f": spread evenly, they would get {100 * registers / (registers + triangles):.1f} %." if registers else "."),
            f"The bundle's own triangles are those that its {side} x {side} pixels see. Effective number of tokens: exp of the "
            "entropy.",
            "In the figure the square marks the bundle; a layer's picture shows the square root of the weight over the "
            "largest one in it, which is given above: what is half as bright has a quarter of the weight.",
        ]
        return Outcome(columns, rows, figure, notes)

    def _figure(self, worker: Worker, records: list[Record], facts: list[dict[str, Any]]) -> Any:
        import matplotlib
        from matplotlib.patches import Rectangle

        from stages.graphics.exr import decode_rgb
        from stages.graphics.tonemap import exposure_for, to_picture
        from stages.renderformer.probes.figures import WIDTH, new_figure, show_picture

        config, patch = worker.config, worker.model.config.bundle_side
        depth = len(worker.model.gathering_layers())
        layers = sorted({round(layer) for layer in np.linspace(0, depth - 1, min(depth, MOST_LAYERS))})
        bundles = sum(len(fact["bundles"]) for fact in facts[: len(records)])
        columns = len(layers) + 2
        side = (WIDTH - 0.4) / columns
        figure = new_figure(bundles * (side + 0.45) + 0.2)
        grid = figure.add_gridspec(bundles, columns)
        colours, line = matplotlib.colormaps["magma"], 0
        for record, fact in zip(records, facts, strict=False):
            arrays = unpack_arrays(record.members["weights.npz"])
            target, prediction = (decode_rgb(record.members[f"{name}.exr"]) for name in ("reference", "prediction"))
            exposure = exposure_for(target)
            triangle_at_pixel = arrays["triangle"]
            for number, bundle in enumerate(fact["bundles"]):
                row, column = divmod(bundle, config.resolution // patch)
                bundle_rows = [entry for entry in fact["weights"] if entry["bundle"] == number]
                for place, (name, image) in enumerate((("path traced", target), ("predicted", prediction))):
                    axes = figure.add_subplot(grid[line, place])
                    show_picture(axes, to_picture(image, exposure), name, "" if place else f"bundle on {bundle_rows[0]['on']}")
                    box = (column * patch - 0.5, row * patch - 0.5)
                    axes.add_patch(Rectangle(box, patch, patch, fill=False, edgecolor="#00d0ff", linewidth=1.6))
                scale = config.drawn_px / config.resolution
                for place, layer in enumerate(layers):
                    weights = arrays["weights"][layer, number]
                    top = float(weights[np.unique(triangle_at_pixel[triangle_at_pixel >= 0])].max(initial=1e-12))
                    lights = 100 * next(entry["lights"] for entry in bundle_rows if entry["layer"] == layer)
                    relative_weights = np.where(triangle_at_pixel >= 0, weights[triangle_at_pixel] / top, 0)
                    pixels = colours(np.clip(relative_weights, 0, 1) ** 0.5, bytes=True)[..., :3].copy()
                    pixels[triangle_at_pixel < 0] = 255
                    axes = figure.add_subplot(grid[line, 2 + place])
                    show_picture(axes, pixels, f"layer {layer + 1}, top {100 * top:.2g} %\non lights {lights:.0f} %")
                    box = (column * patch * scale - 0.5, row * patch * scale - 0.5)
                    axes.add_patch(Rectangle(box, patch * scale, patch * scale, fill=False, edgecolor="#00d0ff", linewidth=1.6))
                line += 1
        return figure


PROBES: tuple[type[Probe], ...] = (Attention,)
