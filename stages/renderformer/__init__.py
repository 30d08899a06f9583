"""The system `renderformer`: its stages in order. Modules are imported one by one, when a stage is needed."""

from pipeline.stage import System

SYSTEM = System(
    name="renderformer",
    modules={
        "collect": "stages.renderformer.s00_collect:Collect",
        "remesh": "stages.renderformer.s01_remesh:Remesh",
        "decimate": "stages.renderformer.s02_decimate:Decimate",
        "scene": "stages.renderformer.s03_variants:Scene",
        "render": "stages.renderformer.s04_render:Render",
        "shard": "stages.renderformer.s05_shard:Shard",
        "train": "stages.renderformer.s06_given:TrainOrGiven",
        "evaluate": "stages.renderformer.s07_evaluate:Evaluate",
        "probe": "stages.renderformer.s08_probe:RunProbe",
    },
    groups=("model",),
    targets={"data": ("shard",), "eval": ("evaluate",)},  # train is a stage
    commands="stages.renderformer.commands:add_commands",
    experiments="stages.renderformer.evaluation.experiments:EXPERIMENTS",
    views="stages.renderformer.viewing:VIEWS",
    packages=(
        "lightmill", "torch", "mitsuba", "drjit", "trimesh", "pymeshlab", "libigl", "scikit-image", "numpy", "scipy",
        "OpenEXR", "pyoidn", "webdataset", "hydra-core", "flip-evaluator",
    ),
)  # fmt: skip
