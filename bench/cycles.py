"""Blender Cycles on a scene's arrays, inside an interpreter that has ``bpy`` (Blender 5 as a module, Python 3.11):

    PYTHON bench/cycles.py SCENE.npz... [--out FOLDER] [--spp 64] [--adaptive 0.01] [--denoise] [--mode physical|released]

Imports nothing of lightmill. Reads ``triangles`` (F, 3, 3), ``vertex_normals`` (F, 3, 3), ``diffuse``, ``specular``,
``emission`` (F, 3), ``roughness``, ``light_index`` (F,), ``camera_to_world`` (V, 4, 4) and ``fov_deg`` (V,), with the meaning
of ``stages.renderformer.records.SceneRecord``; writes ``FOLDER/<name>-<view>.exr`` (float32, linear) and prints one line of
JSON: seconds of export per scene and of each render.

One design choice: all surface triangles are one mesh whose material reads face attributes, so that thousands of materials
cost nothing; lights are a second mesh (camera rays may pass through it) with a constant material per distinct radiance,
since only constant emission lets Cycles' light tree know the power of each light.

Modes:
- ``physical``: 32 bounces, nothing clamped, no glossy filter, box pixel filter: what ``render.mode=physical`` computes.
- ``released``: Blender's defaults, which the released data was made with: 12 bounces, 4 diffuse, 4 glossy, indirect light
  clamped at 10, glossy filter 1.0, Blackman-Harris filter of 1.5 pixels, multiple-scattering GGX.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path

# Out of this folder, or Blender would take this file for its add-on of the same name.
sys.path[:] = [folder for folder in sys.path if Path(folder).resolve() != Path(__file__).resolve().parent]

import bpy  # noqa: E402
import numpy as np  # noqa: E402
from mathutils import Matrix  # noqa: E402

BOUNCES = {"physical": (32, 32, 32), "released": (12, 4, 4)}  # in all, diffuse, glossy


def add_mesh(name: str, triangles: np.ndarray, normals: np.ndarray) -> bpy.types.Object:
    """An object of unshared corners, triangle i of which is triangles[i]."""
    count = len(triangles)
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(3 * count)
    mesh.vertices.foreach_set("co", triangles.ravel())
    mesh.loops.add(3 * count)
    mesh.loops.foreach_set("vertex_index", np.arange(3 * count, dtype=np.int32))
    mesh.polygons.add(count)
    mesh.polygons.foreach_set("loop_start", np.arange(0, 3 * count, 3, dtype=np.int32))
    mesh.polygons.foreach_set("use_smooth", np.ones(count, bool))
    mesh.update()
    mesh.normals_split_custom_set(normals.reshape(-1, 3))
    thing = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(thing)
    return thing


def shader(name: str) -> tuple[bpy.types.Material, bpy.types.NodeTree, bpy.types.Node]:
    """A new material, its nodes and its output node."""
    material = bpy.data.materials.new(name)
    material.node_tree.nodes.clear()
    return material, material.node_tree, material.node_tree.nodes.new("ShaderNodeOutputMaterial")


def add_surface(data: dict[str, np.ndarray], distribution: str) -> None:
    """diffuse / pi + specular * GGX, per triangle."""
    chosen = data["light_index"] < 0
    mesh = add_mesh("surface", data["triangles"][chosen], data["vertex_normals"][chosen]).data
    material, tree, output = shader("surface")
    diffuse, glossy = tree.nodes.new("ShaderNodeBsdfDiffuse"), tree.nodes.new("ShaderNodeBsdfAnisotropic")
    diffuse.inputs["Roughness"].default_value = 0
    glossy.distribution = distribution
    wanted = {"diffuse": diffuse.inputs["Color"], "specular": glossy.inputs["Color"], "roughness": glossy.inputs["Roughness"]}
    for name, socket in wanted.items():
        values = np.ascontiguousarray(data[name][chosen], np.float32)
        kind, field = ("FLOAT_VECTOR", "vector") if values.ndim > 1 else ("FLOAT", "value")
        mesh.attributes.new(name, kind, "FACE").data.foreach_set(field, values.ravel())
        node = tree.nodes.new("ShaderNodeAttribute")
        node.attribute_name = name
        tree.links.new(node.outputs["Vector" if values.ndim > 1 else "Fac"], socket)
    added = tree.nodes.new("ShaderNodeAddShader")
    tree.links.new(diffuse.outputs[0], added.inputs[0])
    tree.links.new(glossy.outputs[0], added.inputs[1])
    tree.links.new(added.outputs[0], output.inputs["Surface"])
    mesh.materials.append(material)


def add_lights(data: dict[str, np.ndarray], visible: bool) -> None:
    """Triangles that emit from both sides and reflect nothing."""
    chosen = data["light_index"] >= 0
    if not chosen.any():
        return
    thing = add_mesh("lights", data["triangles"][chosen], data["vertex_normals"][chosen])
    thing.visible_camera = visible
    radiances, kind = np.unique(data["emission"][chosen], axis=0, return_inverse=True)
    for index, radiance in enumerate(radiances.tolist()):
        material, tree, output = shader(f"light{index}")
        emission = tree.nodes.new("ShaderNodeEmission")
        emission.inputs["Color"].default_value = (*(value / (max(radiance) or 1) for value in radiance), 1)
        emission.inputs["Strength"].default_value = max(radiance)
        tree.links.new(emission.outputs[0], output.inputs["Surface"])
        material.cycles.emission_sampling = "FRONT_BACK"
        thing.data.materials.append(material)
    thing.data.polygons.foreach_set("material_index", kind.ravel().astype(np.int32))


def add_camera(camera_to_world: np.ndarray, fov_deg: float) -> bpy.types.Object:
    lens = bpy.data.cameras.new("camera")
    lens.sensor_fit, lens.angle = "VERTICAL", float(np.radians(fov_deg))
    lens.clip_start, lens.clip_end = 1e-4, 1e4
    camera = bpy.data.objects.new("camera", lens)
    camera.matrix_world = Matrix(camera_to_world.tolist())
    bpy.context.scene.collection.objects.link(camera)
    return camera


def settings(arguments: argparse.Namespace) -> None:
    """All that is not geometry; what is not named here is as Blender's factory has it."""
    scene = bpy.context.scene
    scene.world = None  # black
    scene.render.engine = "CYCLES"
    scene.render.resolution_x = scene.render.resolution_y = arguments.resolution
    scene.render.resolution_percentage = 100
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
    if arguments.threads:
        scene.render.threads_mode, scene.render.threads = "FIXED", arguments.threads
    cycles = scene.cycles
    cycles.device = "GPU" if arguments.gpu else "CPU"
    cycles.samples, cycles.seed = arguments.spp, arguments.seed
    cycles.use_adaptive_sampling = arguments.adaptive > 0
    cycles.adaptive_threshold, cycles.adaptive_min_samples = arguments.adaptive or 0.01, 0
    cycles.use_denoising, cycles.denoiser = arguments.denoise, "OPENIMAGEDENOISE"
    cycles.denoising_input_passes = "RGB_ALBEDO_NORMAL"
    cycles.max_bounces, cycles.diffuse_bounces, cycles.glossy_bounces = BOUNCES[arguments.mode]
    if arguments.mode == "physical":
        cycles.sample_clamp_direct = cycles.sample_clamp_indirect = cycles.blur_glossy = 0
        cycles.pixel_filter_type = "BOX"


def use_gpu() -> None:
    """Let Cycles see the NVIDIA GPUs, through OptiX as it recommends."""
    preferences = bpy.context.preferences.addons["cycles"].preferences
    preferences.compute_device_type = "OPTIX"
    preferences.get_devices()
    gpus = [device for device in preferences.devices if device.type == "OPTIX"]
    if not gpus:
        sys.exit("error: --gpu, but Cycles finds no GPU that OptiX can use")
    for device in preferences.devices:
        device.use = device in gpus


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", type=Path, metavar="SCENE.npz", help="none: only say which Blender this is")
    parser.add_argument("--out", type=Path, default=Path(), metavar="FOLDER", help="default: here")
    parser.add_argument("--resolution", type=int, default=256)
    parser.add_argument("--spp", type=int, default=64, help="samples per pixel, with --adaptive at most")
    parser.add_argument("--adaptive", type=float, default=0.0, help="noise threshold of adaptive sampling; 0: off")
    parser.add_argument("--denoise", action="store_true", help="Open Image Denoise with albedo and normal")
    parser.add_argument("--mode", choices=tuple(BOUNCES), default="physical")
    parser.add_argument("--lights-visible", action="store_true", help="cameras see lights")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=0, help="0: all cores")
    parser.add_argument("--gpu", action="store_true")
    arguments = parser.parse_args()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    if arguments.gpu:
        use_gpu()
    told = {"blender": bpy.app.version_string, "threads": arguments.threads or os.cpu_count(), "scenes": []}
    for path in arguments.scenes:
        began = time.perf_counter()
        with np.load(path) as file:
            data = dict(file)
        if "patches" in data:
            parser.error(f"{path} has textured triangles, which are not handed to Cycles")
        bpy.data.batch_remove([*bpy.data.objects, *bpy.data.meshes, *bpy.data.materials, *bpy.data.cameras])
        settings(arguments)
        add_surface(data, "GGX" if arguments.mode == "physical" else "MULTI_GGX")
        add_lights(data, arguments.lights_visible)
        row = {"name": path.stem, "export": time.perf_counter() - began, "renders": []}
        for view, lens in enumerate(zip(data["camera_to_world"], data["fov_deg"], strict=True)):
            began = time.perf_counter()
            bpy.context.scene.camera = add_camera(*lens)
            bpy.context.scene.render.filepath = str((arguments.out / f"{path.stem}-{view}.exr").resolve())
            bpy.ops.render.render(write_still=True)
            row["renders"].append(time.perf_counter() - began)
        told["scenes"].append(row)
    print("\n" + json.dumps(told), flush=True)


if __name__ == "__main__":
    main()
