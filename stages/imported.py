"""The system `imported`: the line of `renderformer` from scenes on, which come from a folder in the released formats."""

from pipeline.stage import System
from stages.renderformer import SYSTEM as RENDERFORMER

BEFORE = ("collect", "remesh", "decimate")  # what makes scenes there; their sections of the config are not read here

SYSTEM = System(
    name="imported",
    modules={
        **{name: module for name, module in RENDERFORMER.modules.items() if name not in BEFORE},
        "scene": "stages.renderformer.s03_import:ImportScene",
        "probe": "stages.renderformer.s08_probe:ProbeImported",
    },
    groups=(*RENDERFORMER.groups, *BEFORE),
    packages=RENDERFORMER.packages,
)
