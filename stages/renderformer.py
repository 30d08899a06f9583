"""The system `renderformer`: its stages in order. Modules are imported one by one, when a stage is needed."""

from pipeline.stage import System

SYSTEM = System(
    name="renderformer",
    modules={
        "collect": "stages.s00_collect:Collect",
        "remesh": "stages.s01_remesh:Remesh",
        "decimate": "stages.s02_decimate:Decimate",
        "scene": "stages.s03_scene:SampleScene",
        "render": "stages.s04_render:Render",
        "shard": "stages.s05_shard:Shard",
        "train": "stages.s06_given:TrainOrGiven",
        "evaluate": "stages.s07_evaluate:Evaluate",
        "probe": "stages.s08_probe:RunProbe",
    },
    groups=("model",),
    packages=(
        "lightmill", "torch", "mitsuba", "drjit", "trimesh", "pymeshlab", "libigl", "scikit-image", "numpy", "scipy",
        "OpenEXR", "pyoidn", "webdataset", "hydra-core", "flip-evaluator",
    ),
)  # fmt: skip
