"""Speed and memory of the network, forward and training step:

    python bench/model.py        # 205M, 256 px, 1,536 triangles, 4 views of one scene, fp32, against the plain path
    python bench/model.py --models tiny,143m,base --triangles 768,1536,4096 --resolutions 256,512 --views 1,4
    python bench/model.py --train --precisions fp32,mixed,bf16 --scenes 4 [--compile] [--recompute]
    python bench/model.py --train --lpips # a step with LPIPS in its loss against one without, by turns
    python bench/model.py --attention     # ways to attend within scenes of different size

Random triangles and weights; every row in a fresh process, best of several repeats. "of mm": floating-point operations of
matrix products, convolutions and attention (``model.renderformer.flops``) per second, over those of a large ``torch.mm`` of
the same precision that is timed between the repeats. A training step counts as three forward passes. Parts are timed in one
more repeat with a clock at each.
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
import resource
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from model import timing  # noqa: E402
from model.lpips import LPIPS, Features  # noqa: E402
from model.renderformer import layers, reference  # noqa: E402
from model.renderformer.config import ModelConfig  # noqa: E402
from model.renderformer.flops import TRAINING, forward_flops, ideal_seconds  # noqa: E402
from model.renderformer.inputs import constant_material, material_patches  # noqa: E402
from model.renderformer.losses import image_loss  # noqa: E402
from model.renderformer.network import RenderFormer  # noqa: E402
from pipeline.hydra_config import compose  # noqa: E402
from stages.renderformer.s06_train import ModelSection  # noqa: E402
from tests.model.synthetic import batch  # noqa: E402

TOLERANCE = 2e-5  # of the fast path against the plain one, in log10(1 + radiance)
MM = {"cpu": 4096, "cuda": 8192}  # side of the large matrices


clock = time.perf_counter


def use_clock(name: str) -> None:
    """wall, or cpu: the processor time of this process."""
    global clock
    clock = time.process_time if name == "cpu" else time.perf_counter


def timed(work: Callable[[], Any], device: str) -> tuple[float, Any]:
    return timing.timed(work, device, clock)


class Parts:
    """Seconds by part: layers and head by hooks, attention within them by a clock around its one call."""

    def __init__(self, model: RenderFormer, device: str):
        self.seconds: Counter[str] = Counter()
        self.device, self.stage = device, ""
        view = model.view_transformer
        named = [(layer, "encoder layers") for layer in model.transformer.layers]
        named += [(layer, "decoder layers") for layer in view.transformer.layers]
        named.append((view.out_dpt if model.config.use_dpt_decoder else view.out_proj, "head"))
        self.hooks = []
        for module, name in named:
            self.hooks.append(module.register_forward_pre_hook(lambda m, a, name=name: self._enter(name)))
            self.hooks.append(module.register_forward_hook(lambda m, a, o, name=name: self._leave(name)))
        self.attend = layers.attend
        layers.attend = self._attend

    def _enter(self, name: str) -> None:
        timing.wait(self.device)
        self.stage, self.began = name, clock()

    def _leave(self, name: str) -> None:
        timing.wait(self.device)
        self.seconds[name] += clock() - self.began

    def _attend(self, *arguments: Any) -> torch.Tensor:
        seconds, result = timed(lambda: self.attend(*arguments), self.device)
        self.seconds[self.stage.replace("layers", "attention")] += seconds
        self.seconds[self.stage] -= seconds
        return result

    def close(self) -> None:
        for hook in self.hooks:
            hook.remove()
        layers.attend = self.attend


def one(setup: dict[str, Any]) -> dict[str, Any]:
    """One row: a model, a scene size, a precision."""
    use_clock(setup["clock"])
    torch.manual_seed(0)
    device, precision = setup["device"], setup["precision"]
    if setup["threads"]:
        torch.set_num_threads(setup["threads"])
    if precision != "fp32" and device == "cuda":
        torch.set_float32_matmul_precision("high")
    model = RenderFormer(ModelConfig(**setup["model"])).to(device)
    last = model.view_transformer.out_dpt.scratch.output_conv2[2] if model.config.use_dpt_decoder else None
    if last is not None:
        with torch.no_grad():
            last.weight.mul_(300)  # the untrained head's output is nearly constant: make differences show
    data = batch(0, setup["scenes"], setup["triangles"], setup["views"], setup["resolution"])
    cameras, fov = (torch.from_numpy(data[name]).to(device) for name in ("camera_to_world", "fov_deg"))
    image = torch.from_numpy(data["image"]).to(device)
    scenes = model.read(data, device)
    if setup["recompute"]:
        model.activation_checkpointing()
    if setup["compile"]:
        model.compile_layers()
    optimizer = torch.optim.AdamW(model.parameters()) if setup["train"] else None

    # random weights cost what the published ones do
    lpips = LPIPS(Features("vgg")).to(device) if setup["lpips"] else None

    def step(loss_network: LPIPS | None = None) -> torch.Tensor:
        if optimizer is None:
            return model.render(scenes, cameras, fov, setup["resolution"], precision)
        y = model(scenes, cameras, fov, setup["resolution"], precision)
        image_loss(y, image, loss_network, 0.05).backward()
        optimizer.step()
        optimizer.zero_grad()
        return y

    def plain() -> torch.Tensor:
        material = constant_material(
            *(torch.from_numpy(data[n]).to(device) for n in ("diffuse", "specular", "roughness", "emission")),
            model.config.texture_channels,
        )
        patches = material_patches(material, model.config.texture_encode_patch_size)
        scene = [torch.from_numpy(data[name]).to(device) for name in ("triangles", "vertex_normals")]
        mask = torch.from_numpy(data["mask"]).to(device)
        with torch.inference_mode():
            return reference.forward(model, *scene, patches, mask, cameras, fov, setup["resolution"])

    side = MM[device]
    matrices = {
        name: [torch.randn(side, side, device=device).to(getattr(torch, name)) for _ in range(2)]
        for name in (["float32"] if precision == "fp32" else ["float32", "bfloat16"])
    }

    def peaks() -> dict[str, float]:
        return {name: 2 * side**3 / timed(lambda m=m: torch.mm(*m), device)[0] for name, m in matrices.items()}

    step()  # warm-up, and compilation
    if lpips is not None:
        step(lpips)
    best, best_peaks, best_plain, best_lpips, difference = float("inf"), peaks(), float("inf"), float("inf"), None
    for _ in range(setup["repeats"]):
        seconds, y = timed(step, device)
        best = min(best, seconds)
        if lpips is not None:
            best_lpips = min(best_lpips, timed(lambda: step(lpips), device)[0])
        if setup["plain"]:
            seconds, slow = timed(plain, device)
            best_plain, difference = min(best_plain, seconds), float((y - slow).abs().max())
            spread = float(slow.std())
        found = peaks()
        best_peaks = {name: max(value, found[name]) for name, value in best_peaks.items()}
    memory = (
        torch.cuda.max_memory_allocated() if device == "cuda" else 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    )
    shares = {}
    if not setup["compile"]:
        parts = Parts(model, device)
        with torch.no_grad():
            if optimizer is None:
                total, _ = timed(step, device)
            else:
                total, _ = timed(lambda: model(scenes, cameras, fov, setup["resolution"], precision), device)
        parts.close()
        shares = {name: seconds / total for name, seconds in parts.seconds.items()}
        shares["rest"] = 1 - sum(shares.values())
    counts = forward_flops(
        model.config,
        [setup["triangles"]] * setup["scenes"],
        setup["views"],
        setup["resolution"],
        setup["resolution"],
    )
    passes = TRAINING if setup["train"] else 1
    row = {
        "seconds": best,
        "gflop": passes * sum(counts.values()) / 1e9,
        "of_mm": passes * ideal_seconds(counts, best_peaks, precision) / best,
        "memory_gb": memory / 2**30,
        "mm": {name: value / 1e9 for name, value in best_peaks.items()},
        "parts": shares,
        "lpips": best_lpips,
    }
    return row | ({"plain": best_plain, "difference": difference, "spread": spread} if setup["plain"] else {})


def attention(arguments: argparse.Namespace) -> int:
    """Self-attention of eight scenes of 384 to 1,536 tokens, 6 heads of 128 channels, in every way that this device runs."""
    use_clock(arguments.clock)
    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    device, lengths = arguments.device, np.linspace(384, 1536, 8).astype(int).tolist()
    longest = max(lengths)
    print(
        f"attention within {len(lengths)} scenes of {lengths[0]:,} to {longest:,} tokens on {device}, ms, "
        f"best of {arguments.repeats}"
    )
    segments = layers.Segments(lengths)
    for dtype in (torch.float32, torch.bfloat16):
        torch.manual_seed(0)
        packed = [torch.randn(6, sum(lengths), 128, device=device, dtype=dtype) for _ in range(3)]
        mask = (torch.arange(longest) < torch.tensor(lengths)[:, None])[:, None, None].to(device)
        padded = [
            torch.stack([torch.nn.functional.pad(part, (0, 0, 0, longest - part.shape[1])) for part in segments.split(x, 1)])
            for x in packed
        ]
        jagged = [
            torch.nested.nested_tensor([part.transpose(0, 1) for part in segments.split(x, 1)], layout=torch.jagged).transpose(
                1, 2
            )
            for x in packed
        ]
        offsets = torch.tensor([0, *np.cumsum(lengths)], dtype=torch.int32, device=device)

        def varlen(packed=packed, offsets=offsets) -> torch.Tensor:
            from torch.nn.attention.varlen import varlen_attn

            q, k, v = (x.transpose(0, 1).contiguous() for x in packed)
            return varlen_attn(q, k, v, offsets, offsets, longest, longest)

        ways: dict[str, Callable[[], torch.Tensor]] = {
            "scene by scene, no mask (what is used)": lambda p=packed, s=segments: layers.attend_packed(*p, s),
            "padded, keys masked": lambda p=padded, m=mask: layers.attend(*p, m),
            "jagged nested tensors": lambda j=jagged: layers.attend(*j),
            "variable-length kernel": varlen,
        }
        for name, way in ways.items():
            try:
                way()
                best = min(timed(way, device)[0] for _ in range(arguments.repeats))
                print(f"  {str(dtype).removeprefix('torch.'):<9} {name:<40} {1000 * best:8.1f}")
            except (RuntimeError, NotImplementedError, ImportError, AssertionError) as error:
                print(f"  {str(dtype).removeprefix('torch.'):<9} {name:<40} not here: {str(error).splitlines()[0][:60]}")
    return 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    listed = {"models": "base", "triangles": "1536", "resolutions": "256", "views": "4", "precisions": "fp32"}
    for name, default in listed.items():
        parser.add_argument(f"--{name}", default=default, help="comma-separated (default: %(default)s)")
    parser.add_argument("--scenes", type=int, default=1, help="scenes in the batch")
    parser.add_argument("--train", action="store_true", help="a training step instead of a forward pass")
    parser.add_argument("--lpips", action="store_true", help="with --train: a step with LPIPS (VGG16) in the loss as well")
    parser.add_argument("--compile", action="store_true", help="torch.compile")
    parser.add_argument("--recompute", action="store_true", help="activation checkpointing")
    parser.add_argument("--attention", action="store_true", help="compare ways to compute attention, and stop")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--threads", type=int, default=0, help="CPU threads (default: torch's choice)")
    parser.add_argument("--clock", choices=("wall", "cpu"), default="wall", help="cpu: for a busy machine, with --threads 1")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    arguments = parser.parse_args()
    if arguments.attention:
        return attention(arguments)
    if arguments.lpips and not arguments.train:
        parser.error("--lpips is a part of the loss: give --train as well")
    choices = [getattr(arguments, name).split(",") for name in listed]
    # The plain path is compared where the question is one of speed alone: one forward pass in float32.
    plain = not arguments.train and all(len(choice) == 1 for choice in choices) and arguments.precisions == "fp32"
    what = "training step" if arguments.train else "forward pass"
    print(f"{what} of {arguments.scenes} scene(s) on {arguments.device}, best of {arguments.repeats}")
    print("model        triangles    px  views  precision   seconds     GFLOP  of mm  memory   parts")
    failed = False
    for model, triangles, resolution, views, precision in itertools.product(*choices):
        section = ModelSection(**compose([f"model={model}", "stage=train"])["model"])
        setup = vars(arguments) | {
            "model": section.model_dump(exclude={"name"}), "triangles": int(triangles), "resolution": int(resolution),
            "views": int(views), "precision": precision, "plain": plain,
        }  # fmt: skip
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            row = pool.apply(one, (setup,))
        shares = ", ".join(f"{name} {share:.0%}" for name, share in row["parts"].items())
        print(
            f"{model:<12} {int(triangles):>9,} {resolution:>5} {views:>6}  {precision:<9} {row['seconds']:>9.3f} "
            f"{row['gflop']:>9,.0f}  {row['of_mm']:>4.0%}  {row['memory_gb']:>5.2f} GB  {shares}",
            flush=True,
        )
        rates = ", ".join(f"{name} {rate:,.0f} GFLOP/s" for name, rate in row["mm"].items())
        print(f"{'':<13}torch.mm of {MM[arguments.device]}^2: {rates}")
        if arguments.lpips:
            ratio = row["lpips"] / row["seconds"]
            print(f"{'':<13}with LPIPS in the loss: {row['lpips']:.3f} s, {ratio:.2f} times the step without")
        if plain:
            failed = not row["difference"] < TOLERANCE
            print(
                f"{'':<13}plain path: {row['plain']:.3f} s, {row['plain'] / row['seconds']:.2f} times; largest difference "
                f"{row['difference']:.2g} of outputs that spread by {row['spread']:.2g}"
                + (f", OVER {TOLERANCE:g}" if failed else "")
            )
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
