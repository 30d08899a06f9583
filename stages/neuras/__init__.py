"""The system `neuras`, neural rasterization of large scenes: its stages in order (ICCV 2023)."""

from pipeline.stage import System

SYSTEM = System(
    name="neuras",
    modules={
        "capture": "stages.neuras.s00_capture:Capture",
        "scaffold": "stages.neuras.s01_scaffold:Scaffold",
        "refine": "stages.neuras.s02_refine:Refine",
        "atlas": "stages.neuras.s03_atlas:Atlas",
        "fit": "stages.neuras.s04_fit:Fit",
        "bake": "stages.neuras.s05_bake:Bake",
        "evaluate": "stages.neuras.s06_evaluate:Evaluate",
    },
    targets={"data": ("atlas",), "train": ("fit",), "eval": ("evaluate",)},
    commands="stages.neuras.commands:add_commands",
    experiments="stages.neuras.evaluation.tables:EXPERIMENTS",
    views="stages.neuras.viewing:VIEWS",
    packages=(
        "lightmill",
        "torch",
        "mitsuba",
        "drjit",
        "pymeshlab",
        "xatlas",
        "moderngl",
        "numpy",
        "scipy",
        "pyoidn",
        "hydra-core",
    ),
)
