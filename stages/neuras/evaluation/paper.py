"""What the paper publishes, table by table: its rows and figures, and what they are of.

"Real-Time Neural Rasterization for Large Scenes", ICCV 2023. Figures of other methods are the paper's own measurements of them;
they are shown beside ours and marked as published, because nothing of them runs here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Row:
    """A row. file: its config in ``conf/neuras/experiment/<table>/``, "" where the paper's figures are all there is.

    method: which pictures of that evaluation are meant. figures: published ones by column, see ``tables.COLUMNS``.
    """

    label: str
    file: str = ""
    figures: Mapping[str, float] = field(default_factory=dict)
    method: str = "ours"


@dataclass(frozen=True)
class PaperTable:
    """A table or figure of the paper. facts: what its runs were, beside which ``tables.here`` puts ours; by name, in order.

    paired: whether rows are of the same frames, so that differences to the first are taken frame by frame.
    """

    name: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[Row, ...]
    facts: Mapping[str, str]
    note: str = ""
    paired: bool = True


QUALITY = ("psnr", "ssim", "lpips")
LOG_53 = {
    "scenes": "log-53 of PandaSet, real",
    "images": "1920 x 1080",
    "held out": "every other frame",
    "texture": "8192 x 8192, one level, 12 channels",
    "skyboxes": "6",
    "training": "20,000 steps, learning rate 0.01",
    "perceptual loss": "VGG16",
}
PLAIN = "plain colours"
WARPING = "multi-view warping"


def _quality(*values: float, **others: float) -> dict[str, float]:
    return {**dict(zip(QUALITY, values, strict=True)), **others}


TABLES = (
    PaperTable(
        "table1",
        "Table 1: a driven street",
        ("mse", *QUALITY, "psnr_2", "psnr_3", "fid_2", "fid_3", "memory", "fps"),
        (
            Row("ours", "ours", {"mse": 0.0030, **_quality(25.45, 0.75, 0.31, fid_2=105.6, fid_3=111.6, memory=4538, fps=120)}),
            Row(WARPING, "ours", _quality(20.55, 0.64, 0.39, fid_2=164, fid_3=177, fps=50), "warping"),
            Row(PLAIN, "plain"),
            Row("ours, with surfels and residuals", "extended"),
            Row("Instant-NGP", figures=_quality(24.76, 0.79, 0.40, fid_2=134.2, fid_3=135.8, fps=3.2)),
            Row("UniSim", figures=_quality(26.28, 0.78, 0.26, fid_2=92.8, fid_3=100.6, fps=1.4)),
            Row("ENeRF", figures=_quality(24.92, 0.77, 0.34, fid_2=191, fid_3=244, fps=5.1)),
            Row("FVS", figures=_quality(20.87, 0.71, 0.29, fid_2=116, fid_3=123, fps=0.3)),
        ),
        {**LOG_53, "scenes": "mean over 9 sequences of PandaSet, real", "frames per second": "NVIDIA A5000, 1920 x 1080"},
        "PSNR at 2 and 3 m beside the lane needs the truth there, which only a made-up street has.",
    ),
    PaperTable(
        "table2",
        "Table 2: a flight",
        (*QUALITY, "fps"),
        (
            Row("ours", "ours", _quality(24.19, 0.790, 0.176, fps=462)),
            Row(WARPING, "ours", _quality(21.11, 0.738, 0.248, fps=65), "warping"),
            Row(PLAIN, "plain"),
            Row("Instant-NGP", figures=_quality(24.40, 0.780, 0.241, fps=8.7)),
            Row("UniSim", figures=_quality(24.37, 0.792, 0.204, fps=4.9)),
        ),
        {
            "scenes": "mean over 5 scenes of BlendedMVS",
            "held out": "a random half",
            "training": "20,000 steps, learning rate 0.01",
            "frames per second": "NVIDIA A5000",
        },
    ),
    PaperTable(
        "table3",
        "Table 3: what the networks give",
        QUALITY,
        (
            Row("full", "full", _quality(25.34, 0.738, 0.308)),
            Row("without view direction", "no_view_direction", _quality(25.01, 0.728, 0.316)),
            Row("without networks", "no_mlp", _quality(24.48, 0.664, 0.374)),
        ),
        LOG_53,
    ),
    PaperTable(
        "table4",
        "Table 4: what quantization gives",
        ("psnr", "lpips", "psnr_2", "psnr_3", "fid_2", "fid_3", "stored"),
        (
            Row("with codes", "with_vq", {"psnr": 25.34, "lpips": 0.308, "fid_2": 78.2, "fid_3": 95.3, "stored": 394}),
            Row("without", "without_vq", {"psnr": 25.46, "lpips": 0.317, "fid_2": 81.5, "fid_3": 98.3, "stored": 4644}),
        ),
        LOG_53,
    ),
    PaperTable(
        "figure7",
        "Figure 7: the mesh's resolution",
        ("vertices", "faces", "charts", *QUALITY, "psnr_3", "stored", "fps"),
        (
            Row("about 50,000 vertices", "vertices_50k"),
            Row("about 5,000 vertices", "vertices_5k"),
            Row("the whole scaffold", "whole"),
        ),
        {**LOG_53, "scenes": "a sequence of PandaSet, real; meshes of 50,000 and 500,000 vertices"},
        "The paper shows pictures, of similar quality, and gives no figures. The whole scaffold's charts are made without "
        "xatlas (`atlas.charts=planar`).",
    ),
    PaperTable(
        "table5",
        "Table 5: objects",
        (*QUALITY, "fps"),
        (
            Row("car", "car"),
            Row("house", "house"),
            Row("tree", "tree"),
            Row("the same tree, with surfels", "tree_surfels"),
            Row("chair", figures=_quality(33.15, 0.975, 0.036, fps=461)),
            Row("lego", figures=_quality(30.66, 0.951, 0.061, fps=461)),
            Row("chair by MobileNeRF", figures={"psnr": 34.02, "fps": 720}),
            Row("lego by MobileNeRF", figures={"psnr": 34.18, "fps": 720}),
        ),
        {
            "scenes": "objects of NeRF's synthetic set",
            "images": "800 x 800",
            "held out": "200 views of each, 100 for training",
            "frames per second": "NVIDIA A5000",
        },
        "Other objects, so figures of different rows are not comparable. Ours are made from the same parts as the street.",
        paired=False,
    ),
    PaperTable(
        "table6",
        "Table 6: meshes of other reconstructions",
        ("faces", *QUALITY, "psnr_3", "fps"),
        (
            Row("our scaffold: Poisson", "poisson"),
            Row("marching cubes of a distance field", "distance_field"),
            Row("the true mesh", "true_mesh"),
            Row("marching cubes of Instant-NGP", figures={"psnr": 20.26, "fps": 455}),
            Row("marching cubes of UniSim", figures={"psnr": 21.19, "fps": 336}),
            Row("Instant-NGP itself", figures={"psnr": 23.55, "fps": 8.2}),
            Row("UniSim itself", figures={"psnr": 23.30, "fps": 4.7}),
        ),
        {
            "scenes": "the church of BlendedMVS",
            "held out": "a random half",
            "training": "20,000 steps, learning rate 0.01",
            "frames per second": "NVIDIA A5000",
        },
    ),
    PaperTable(
        "limits",
        "Section 4.4: past the paper's limits",
        (*QUALITY, "psnr_2", "psnr_3", "stored"),
        (
            Row("as in the tables above", "ours"),
            Row("surfels where the surface passes points by", "extended", method="textures"),
            Row("and residuals of the nearest photos", "extended"),
            Row("the same, with surfels that photos see through", "all_surfels"),
            Row("vertices that move until photos agree", "vertices"),
            Row("one texture level", "one_level"),
            Row("pixels that read the levels they ask for, no others", "exact_levels"),
            Row("near skyboxes begin half opaque", "near_opacity"),
            Row("one skybox, the farthest", "one_skybox"),
            Row("noise on the view direction", "direction_noise"),
        ),
        {},
        "Each of the first three rows has what the one above has, and one thing more; the fourth keeps what the third leaves "
        "out. Every other row differs from the first in one thing. Vertices that move do not make photos agree better on this "
        "street, so they stay where they are.",
    ),
)
