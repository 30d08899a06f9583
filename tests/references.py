"""Compare our path tracer with Cycles' images: ``python tests/references.py SCENE.json... --references FOLDER``

FOLDER holds ``<scene>-physical-128.exr``, lights visible, box filter, no clamping. Prints how far the mean of values clamped
at 4 is, averaged over ``--runs`` renders. With ``--cycles-python`` naming an interpreter that has ``bpy`` (Blender as a module,
Python 3.11), Cycles renders the same arrays again at ``--cycles-spp``, which tells the noise of a reference from a real
difference (the last figure carries noise as well). Exits with 1 if a mean is farther than ``--tolerance`` from the reference.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

RESOLUTION = 128


def render_with_cycles(arrays: Path, spp: int, out: Path) -> None:
    """Runs inside Blender's interpreter: one object per material, diffuse plus GGX added, as the scene format defines it."""
    import bpy
    from mathutils import Matrix

    with np.load(arrays) as file:
        data = dict(file)
    scene = bpy.context.scene
    for thing in list(bpy.data.objects):
        bpy.data.objects.remove(thing)
    key = np.concatenate([data["diffuse"], data["specular"], data["roughness"][:, None], data["emission"]], axis=1)
    kinds, of_kind = np.unique(key, axis=0, return_inverse=True)
    for index, kind in enumerate(kinds):
        mine = of_kind.ravel() == index
        mesh = bpy.data.meshes.new(f"mesh{index}")
        corners = data["triangles"][mine].reshape(-1, 3)
        mesh.from_pydata(corners.tolist(), [], np.arange(len(corners)).reshape(-1, 3).tolist())
        mesh.polygons.foreach_set("use_smooth", np.ones(int(mine.sum()), bool))
        mesh.update()
        mesh.normals_split_custom_set(data["vertex_normals"][mine].reshape(-1, 3).tolist())
        material = bpy.data.materials.new(f"material{index}")
        material.use_nodes = True
        nodes, links = material.node_tree.nodes, material.node_tree.links
        nodes.clear()
        output = nodes.new("ShaderNodeOutputMaterial")
        if kind[7:].any():
            emission = nodes.new("ShaderNodeEmission")
            emission.inputs["Color"].default_value = (*(kind[7:] / kind[7:].max()), 1)
            emission.inputs["Strength"].default_value = float(kind[7:].max())
            links.new(emission.outputs[0], output.inputs[0])
        else:
            diffuse, glossy = nodes.new("ShaderNodeBsdfDiffuse"), nodes.new("ShaderNodeBsdfAnisotropic")
            diffuse.inputs["Color"].default_value, diffuse.inputs["Roughness"].default_value = (*kind[:3], 1), 0
            glossy.distribution, glossy.inputs["Color"].default_value = "GGX", (*kind[3:6], 1)
            glossy.inputs["Roughness"].default_value = float(kind[6])
            added = nodes.new("ShaderNodeAddShader")
            for slot, shader in enumerate((diffuse, glossy)):
                links.new(shader.outputs[0], added.inputs[slot])
            links.new(added.outputs[0], output.inputs[0])
        mesh.materials.append(material)
        scene.collection.objects.link(bpy.data.objects.new(f"object{index}", mesh))
    lens = bpy.data.cameras.new("camera")
    lens.sensor_fit, lens.angle, lens.clip_start = "VERTICAL", float(np.radians(data["fov_deg"])), 1e-3
    camera = bpy.data.objects.new("camera", lens)
    camera.matrix_world = Matrix(data["camera_to_world"].tolist())
    scene.collection.objects.link(camera)
    scene.camera = camera
    scene.world = bpy.data.worlds.new("world")
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs[0].default_value = (0, 0, 0, 1)
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.device, cycles.samples, cycles.use_adaptive_sampling, cycles.use_denoising = "CPU", spp, False, False
    for name in ("max", "diffuse", "glossy", "transmission"):
        setattr(cycles, f"{name}_bounces", 32)
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = cycles.blur_glossy = 0
    cycles.pixel_filter_type = "BOX"
    scene.render.resolution_x = scene.render.resolution_y = RESOLUTION
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
    scene.render.filepath = str(out)
    bpy.ops.render.render(write_still=True)


def clamped_mean(path: Path) -> float:
    """Of an EXR's values clamped at 4: a visible light would outweigh everything else."""
    from stages.exr import read_rgb

    return float(np.minimum(read_rgb(path), 4).mean())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE")
    parser.add_argument("--references", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--spp", type=int, default=1024, help="of each of our renders, default %(default)s")
    parser.add_argument("--runs", type=int, default=4, help="our renders per scene, default %(default)s")
    parser.add_argument("--tolerance", type=float, default=0.01, help="relative, default %(default)s")
    parser.add_argument("--cycles-python", metavar="PYTHON", help="an interpreter that has bpy")
    parser.add_argument("--cycles-spp", type=int, default=16384, help="default %(default)s")
    args = parser.parse_args()

    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    from stages.released import load_scene
    from stages.trace import trace

    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        out, arrays = Path(folder) / "out.exr", Path(folder) / "scene.npz"
        for path in args.scenes:
            ours = []
            for seed in range(args.runs):
                trace(path, out, RESOLUTION, args.spp, denoise=False, seed=seed)
                ours.append(clamped_mean(out))
            mean, error = np.mean(ours), np.std(ours) / max(1, len(ours) - 1) ** 0.5
            truth = clamped_mean(args.references / f"{path.stem}-physical-{RESOLUTION}.exr")
            line = f"{path.stem:16s} reference {mean / truth - 1:+.2%} +- {error / truth:.2%}"
            if args.cycles_python:
                scene = load_scene(path)
                names = ("triangles", "vertex_normals", "diffuse", "specular", "roughness", "emission")
                lens = {"camera_to_world": scene.camera_to_world[0], "fov_deg": scene.fov_deg[0]}
                np.savez(arrays, **{name: getattr(scene, name) for name in names}, **lens)
                command = [args.cycles_python, __file__, "--inside", str(arrays), str(args.cycles_spp), str(out)]
                subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
                again = clamped_mean(out)
                line += f"; Cycles at {args.cycles_spp} samples: {mean / again - 1:+.2%}, "
                line += f"itself {again / truth - 1:+.2%} from the reference"
            failed += not abs(mean / truth - 1) <= args.tolerance
            print(line, flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    if sys.argv[1:2] == ["--inside"]:
        render_with_cycles(Path(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4]))
    else:
        sys.exit(main())
