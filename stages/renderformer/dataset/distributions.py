"""What is in the shards, measured: quantities of scenes, lights, views and triangles, by split, and how they are distributed.

One design choice: a quantity is a plain array of all its values over the scenes that were read, so that ranges, histograms and
means come from the same numbers.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

Quantities = Mapping[str, np.ndarray]  # name -> all its values

SPLITS = ("train", "validation", "test")  # in this order
PLOTS = (  # quantity, label, scale
    ("triangles", "triangles per scene", "linear"),
    ("lights", "lights per scene", "integer"),
    ("textured", "share of textured triangles per scene", "linear"),
    ("roughness", "roughness, per triangle", "linear"),
    ("emission", "emission of a light's triangle", "log"),
    ("camera distance", "camera to origin, scene units", "linear"),
    ("light distance", "light to origin, scene units", "linear"),
    ("field of view", "field of view, degrees", "linear"),
    ("mean radiance", "exposure: mean radiance of a view", "log"),
    ("samples", "samples per pixel of a view", "log2"),
    ("error", "estimated error of a view, log10(1 + x)", "log"),
    ("noise", "noise floor of a view, log10(1 + x)", "log"),
)


def split_order(name: str) -> int:
    """Where a split stands among the others; one of another name stands last."""
    return SPLITS.index(name) if name in SPLITS else len(SPLITS)


def measure_scenes(draft: Any, rows: Iterable[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """Quantity -> its values over the scenes (lights, cameras, views, triangles of them)."""
    from stages.graphics.arrays import unpack_json
    from stages.renderformer.dataset.encoding import decode_scene

    values: dict[str, list[Any]] = {
        name: []
        for name in (
            "triangles", "lights", "roughness", "camera distance", "light distance", "field of view", "mean radiance",
            "samples", "error", "clamped", "emission", "vertex", "bytes", "noise", "noise relit", "noise psnr", "textured",
        )
    }  # fmt: skip
    for row in rows:
        members = draft.read(row["id"], ["scene.npz", "meta.json"]).members
        scene = decode_scene(row["id"], members["scene.npz"], members["meta.json"])
        reflects = scene.light_index < 0
        values["triangles"].append([len(scene.triangles)])
        values["lights"].append([scene.n_lights])
        values["textured"].append([0.0 if scene.patch_index is None else np.mean(scene.patch_index >= 0)])
        values["roughness"].append(scene.roughness[reflects])
        values["emission"].append(scene.emission[~reflects].max(axis=1))
        values["vertex"].append([scene.triangles[reflects].min(initial=0), scene.triangles[reflects].max(initial=0)])
        views = unpack_json(members["meta.json"])["views"]
        values["camera distance"].append(np.linalg.norm(scene.camera_to_world[views, :3, 3], axis=1))
        values["field of view"].append(scene.fov_deg[views])
        for light in range(scene.n_lights):
            values["light distance"].append([np.linalg.norm(scene.triangles[scene.light_index == light].mean(axis=(0, 1)))])
        for view in scene.meta["render"]["views"]:
            if view.get("status") == "ok":
                for name, key in (("mean radiance", "mean"), ("samples", "spp"), ("error", "error"), ("clamped", "clamped")):
                    if view.get(key) is not None:
                        values[name].append([view[key]])
                if noise := view.get("noise"):  # of views that were rendered twice
                    values["noise"].append([noise["sum"]["log_error"]])
                    values["noise psnr"].append([noise["sum"]["psnr"]])
                    values["noise relit"].append([relit["log_error"] for relit in noise["reweighted"]])
        values["bytes"].append([len(members["scene.npz"])])
    return {name: np.concatenate(parts).astype(float) if parts else np.zeros(0) for name, parts in values.items()}


def plot_distributions(figure: Any, by_split: Mapping[str, Quantities]) -> None:
    """A histogram per quantity on the figure, with a curve per split, each normalised to shares."""
    for axes, (name, label, scale) in zip(figure.subplots(3, 4).flat, PLOTS, strict=True):
        axes.set_xlabel(label)
        values = {split: measured[name] for split, measured in by_split.items() if len(measured[name])}
        plot_histogram(axes, {split: values[split] for split in sorted(values, key=split_order)}, scale)


def plot_histogram(axes: Any, values: Quantities, scale: str) -> None:
    """Shares of the values of each split in common bins. scale: linear, integer, log or log2."""
    from stages.graphics.page.plots import colour

    pooled = np.concatenate(list(values.values())) if values else np.zeros(0)
    if scale in ("log", "log2"):
        pooled = pooled[pooled > 0]
    if not len(pooled):
        axes.text(0.5, 0.5, "not estimated", ha="center", va="center", transform=axes.transAxes)
        axes.set(xticks=[], yticks=[])
        return
    low, high = pooled.min(), pooled.max()
    if high - low <= 1e-6 * abs(high):
        scale = "constant"
    edges = bin_edges(low, high, len(pooled), scale)
    for number, (split, split_values) in enumerate(values.items()):
        shares = np.histogram(split_values, edges)[0] / len(split_values)
        style = {"fill": True, "alpha": 0.35} if split == "train" else {"linewidth": 1.5}
        axes.stairs(shares, edges, label=f"{split} ({len(split_values):,})", color=colour(number), **style)
    if scale in ("log", "log2"):
        axes.set_xscale("log", base=2 if scale == "log2" else 10)
        ticks = log_ticks(low, high, edges, scale)
        axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.minorticks_off()
    if scale == "constant":
        axes.set_xticks([low], [f"{low:.4g}"])
        axes.set_xlim(*(edges + np.diff(edges) * [-1, 1]))
    axes.set_ylabel("share")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)


def bin_edges(low: float, high: float, count: int, scale: str) -> np.ndarray:
    """Bins for ``count`` values between low and high; one bin over a value that is ``constant``."""
    if scale == "constant":
        return low + np.array([-0.5, 0.5]) * (abs(low) or 1.0)
    if scale == "integer":
        return np.arange(np.floor(low), np.floor(high) + 2) - 0.5
    if scale == "log2":
        return 2.0 ** (np.arange(np.floor(np.log2(low)), np.floor(np.log2(high)) + 2) - 0.5)
    bins = int(np.clip(2 * count**0.5, 8, 40))
    return (np.geomspace if scale == "log" else np.linspace)(low, high, bins + 1)


def log_ticks(low: float, high: float, edges: np.ndarray, scale: str) -> np.ndarray:
    """At most six or so ticks of a logarithmic axis: powers, or rounded values where no two powers lie in it."""
    if scale == "log2":
        ticks = 2.0 ** np.arange(np.floor(np.log2(low)), np.floor(np.log2(high)) + 1)
    elif high > 30 * low:
        ticks = 10.0 ** np.arange(np.ceil(np.log10(low)), np.floor(np.log10(high)) + 1)
    else:
        ticks = np.array([float(f"{tick:.2g}") for tick in np.geomspace(edges[0], edges[-1], 4)])
    return ticks[:: -(-len(ticks) // 6)]


def ranges(by_split: Mapping[str, Quantities]) -> list[tuple[str, ...]]:
    """Rows of what was measured: (quantity, least, median, largest)."""
    labels = {
        "vertex": "vertex coordinate (without lights)",
        **{name: label for name, label, _ in PLOTS},
        "bytes": "bytes of scene.npz",
    }
    rows = []
    for name, label in labels.items():
        values = np.concatenate([measured[name] for measured in by_split.values()])
        if len(values):
            rows.append((label, *(f"{value:.4g}" for value in (values.min(), np.median(values), values.max()))))
    return rows


def noise_floor(measured: Quantities) -> str:
    """How far images are from noiseless ones: of views rendered twice, and as the renderer estimates it."""

    def spread(values: np.ndarray) -> str:
        return (
            f"{values.mean():.4f} in the mean, {np.median(values):.4f} in the median, {np.quantile(values, 0.95):.4f} at 95 %"
        )

    noise, errors = measured["noise"], measured["error"]
    sentences = []
    if len(noise):
        sentences.append(
            f"Noise floor, of {len(noise):,} views rendered twice, independently: mean absolute error of log10(1 + radiance) "
            f"{spread(noise)}; PSNR of values clamped to 1 {measured['noise psnr'].mean():.1f} dB; with reweighted lights "
            f"{spread(measured['noise relit'])}."
        )
    if len(errors):
        sentences.append(f"Error of a view as the renderer estimates it, log10(1 + radiance): {spread(errors)}.")
    return " ".join(sentences) or "Noise floor: not measured; every view has a fixed number of samples and was rendered once."
