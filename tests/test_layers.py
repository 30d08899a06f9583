"""Who may import whom: no circle between files, and no arrow from a lower room of the house to a higher one.

A room is a folder; files directly in a folder that also has folders are each a room of their own. Imports count wherever they
stand: at the top, in a function, under TYPE_CHECKING. The engine's one dynamic import is by name and is no arrow.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Mapping
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
HOUSE = ("lightmill", "stages", "model", "pipeline")

# From the roof to the ground. A room may import rooms of the lines below its own, and none of its own line. A package that has
# rooms stands for its __init__.py.
LAYERS = """
lightmill
stages.cli
stages.viewer
stages.renderformer
stages.renderformer.commands
stages.renderformer.s03_variants  stages.renderformer.s06_given
stages.renderformer.s00_collect  stages.renderformer.s01_remesh  stages.renderformer.s02_decimate  \
stages.renderformer.s03_import  stages.renderformer.s03_scene  stages.renderformer.s04_render  \
stages.renderformer.s05_shard  stages.renderformer.s06_train  stages.renderformer.s07_evaluate  stages.renderformer.s08_probe
stages.renderformer.viewing
stages.renderformer.probes
stages.renderformer.evaluation
stages.renderformer.inference
stages.renderformer.importing
stages.renderformer.rendering
stages.renderformer.dataset  stages.renderformer.scenes  stages.renderformer.objects
stages.renderformer.views  stages.renderformer.guides  stages.renderformer.hub
stages.renderformer.records
stages.neuras.commands  stages.neuras.viewing
stages.neuras.s03_atlas  stages.neuras.s04_fit  stages.neuras.s05_bake  stages.neuras.s06_evaluate
stages.neuras.s00_capture  stages.neuras.s01_scaffold  stages.neuras.s02_refine
stages.neuras.evaluation
stages.neuras.captures  stages.neuras.street  stages.neuras.surfaces  stages.neuras.baking
stages.neuras.rasterizing
stages.neuras.records
stages.neuras
stages
stages.graphics.geometry.load  stages.graphics.geometry.side_files  stages.graphics.geometry.remesher  \
stages.graphics.geometry.decimator  stages.graphics.geometry.sheet
stages.graphics.geometry.formats
stages.graphics.geometry.colours  stages.graphics.geometry.measure
stages.graphics.geometry.records  stages.graphics.geometry.paths
stages.graphics.geometry  stages.graphics.mitsuba  stages.graphics.statistics  stages.graphics.video  \
stages.graphics.device  stages.graphics.denoising  stages.graphics.panels
stages.graphics.metrics  stages.graphics.exr  stages.graphics.casting
stages.graphics.arrays  stages.graphics.tonemap  stages.graphics.cameras  stages.graphics.page  stages.graphics.browser  \
stages.graphics.lpips_setting
stages.graphics
model.renderformer.training  model.neuras
model.renderformer.checkpoint
model.renderformer.architectures  model.renderformer.reference  model.renderformer.initial  model.renderformer.timing
model.renderformer.guided
model.renderformer.network
model.renderformer.flops  model.renderformer.dpt  model.renderformer.inputs  model.renderformer.losses
model.renderformer.layers  model.renderformer.base  model.renderformer.config  model.renderformer.recipe
model.renderformer
model.training
model.fetching
model.lpips  model.inception  model.timing
model.weights  model.pickles
model.file_kinds
model.errors
model
pipeline.experiments
pipeline.__main__  pipeline.job  pipeline.commands
pipeline.sweep  pipeline.repair
pipeline.run
pipeline.make
pipeline.mapping
pipeline.making
pipeline.plan
pipeline.cluster
pipeline.executor
pipeline.code  pipeline.hydra_config  pipeline.worker
pipeline.stage  pipeline.status
pipeline.store
pipeline.config  pipeline.interrupts  pipeline.keys  pipeline.progress
pipeline.terminal
pipeline.errors  pipeline.atomic  pipeline.gpus
pipeline
"""

# What the order would allow and yet may not be.
APART = {
    "model": ("pipeline",),  # networks know no engine
}
ANYBODYS = {"pipeline.atomic"}  # writes a file; it knows nothing of the engine, and imports nothing of the house

# Files that may import a file of a higher room, and why.
EXCEPTIONS = {
    ("stages.renderformer.inference.room", "stages.renderformer.s00_collect"): "a user's mesh goes the way of the data's",
    ("stages.renderformer.inference.room", "stages.renderformer.s01_remesh"): "a user's mesh goes the way of the data's",
    ("stages.renderformer.inference.room", "stages.renderformer.s02_decimate"): "a user's mesh goes the way of the data's",
    ("stages.renderformer.evaluation.ablation", "stages.renderformer.s06_train"): "a table tells what its trainings cost",
}

Graph = Mapping[str, set[str]]


def modules(root: Path, packages: Iterable[str]) -> dict[str, Path]:
    """Files by module name; a package's __init__.py has the package's name."""
    files = {}
    for package in packages:
        for path in [root / f"{package}.py", *sorted((root / package).rglob("*.py"))]:
            if path.is_file():
                files[".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__")] = path
    return files


def imports(files: Mapping[str, Path]) -> dict[str, set[str]]:
    """Every file's arrows to other files of the house."""
    graph = {}
    for name, path in files.items():
        package = name if path.name == "__init__.py" else name.rpartition(".")[0]
        imported = set()
        for node in ast.walk(ast.parse(path.read_bytes())):
            if isinstance(node, ast.Import):
                imported |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                base = ".".join([*package.split(".")[: package.count(".") + 2 - node.level], *filter(None, [node.module])])
                base = base if node.level else node.module
                for alias in node.names:
                    imported.add(inner if (inner := f"{base}.{alias.name}") in files else base)
        graph[name] = {other for other in imported if other in files and other != name}
    return graph


def circles(graph: Graph) -> list[list[str]]:
    """Files that reach themselves along arrows, those that reach one another together."""
    reached: dict[str, set[str]] = {}
    for start in graph:
        seen: set[str] = set()
        todo = list(graph[start])
        while todo:
            if (name := todo.pop()) not in seen:
                seen.add(name)
                todo += graph.get(name, ())
        reached[start] = seen
    groups = {tuple(sorted({a, *(b for b in reached[a] if a in reached.get(b, ()))})) for a in graph if a in reached[a]}
    return [list(group) for group in sorted(groups)]


def room(name: str, files: Iterable[str]) -> str:
    """The folder that the file lies in; or the file, where folders lie beside it."""
    if any(other.startswith(f"{name}.") for other in files):
        return name  # a package's __init__.py
    folder = name.rpartition(".")[0]
    inside = [other.removeprefix(f"{folder}.") for other in files if other.startswith(f"{folder}.")]
    return name if not folder or any("." in rest for rest in inside) else folder


def forbidden(
    graph: Graph, layers: str, apart: Mapping[str, Iterable[str]], exceptions: Iterable[tuple[str, str]]
) -> list[str]:
    """What is wrong with the arrows, one line each."""
    height = {name: -row for row, line in enumerate(layers.strip().splitlines()) for name in line.split()}
    wrong, unused = [], set(exceptions)
    for a in sorted(graph):
        if room(a, graph) not in height:
            wrong.append(f"{a}: its room {room(a, graph)} has no place in LAYERS")
            continue
        for b in sorted(graph[a]):
            above, below = room(a, graph), room(b, graph)
            crossed = any(a.split(".")[0] == one and b.split(".")[0] in others for one, others in apart.items())
            crossed = crossed and b not in ANYBODYS
            if above == below or (below in height and height[above] > height[below] and not crossed):
                continue
            if (a, b) in unused:
                unused.remove((a, b))
            elif below in height:
                wrong.append(f"{a} imports {b}, which is not below it")
    return wrong + [f"{a} no longer imports {b}: strike the exception" for a, b in sorted(unused)]


@pytest.fixture(scope="module")
def graph() -> dict[str, set[str]]:
    return imports(modules(ROOT, HOUSE))


def test_no_circle_between_files(graph):
    assert circles(graph) == []


def test_arrows_point_down(graph):
    assert forbidden(graph, LAYERS, APART, EXCEPTIONS) == []


def test_what_is_anybodys_imports_nothing_of_the_house(graph):
    assert not set().union(*(graph[name] for name in ANYBODYS))


def test_the_engine_imports_one_module_by_name():
    """Otherwise it could reach what no arrow shows."""
    calls = {}
    for name, path in modules(ROOT, ["pipeline"]).items():
        for node in ast.walk(ast.parse(path.read_bytes())):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                assert not re.fullmatch(r"(stages|model)(\.\w+)+(:\w+)?", node.value), f"{name} names {node.value}"
            if isinstance(node, ast.Call) and ast.unparse(node.func).endswith(("import_module", "__import__")):
                calls[name] = calls.get(name, 0) + 1
    assert calls == {"pipeline.stage": 2, "pipeline.cluster": 1}  # a system and its stages; a kind of Dask cluster


# --- the checker itself -----------------------------------------------------------------------------------------------

SMALL = "house.top\nhouse.low\nhouse.ground  house.beside"


@pytest.fixture
def house(tmp_path):
    """house(top="import ...", ...) -> the arrows of a made-up package of two folders and two files."""

    def build(**code: str) -> dict[str, set[str]]:
        files = {"top": "top/one.py", "other": "top/two.py", "low": "low/one.py", "ground": "ground.py", "beside": "beside.py"}
        for name, path in files.items():
            target = tmp_path / "house" / path
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(code.get(name, ""))
        return imports(modules(tmp_path, ["house"]))

    return build


def test_a_good_house_passes(house):
    graph = house(
        top="from house.low import one\nfrom .two import x", other="import json, house.ground", low="from .. import ground"
    )
    assert graph["house.top.one"] == {"house.low.one", "house.top.two"}
    assert graph["house.top.two"] == {"house.ground"} and graph["house.low.one"] == {"house.ground"}
    assert circles(graph) == [] and forbidden(graph, SMALL, {}, []) == []


def test_circles_are_found(house):
    typed = "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from house.top.two import x"
    inside = "def f():\n    import house.top.one"
    assert circles(house(top=typed, other=inside)) == [["house.top.one", "house.top.two"]]
    assert circles(house(top="import house.low.one", low="import house.ground", ground=inside)) == [
        ["house.ground", "house.low.one", "house.top.one"]
    ]


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ({"low": "from house.top.one import x"}, "house.low.one imports house.top.one, which is not below it"),
        ({"low": "def f():\n    from ..top import two"}, "house.low.one imports house.top.two, which is not below it"),
        ({"ground": "from house import beside"}, "house.ground imports house.beside, which is not below it"),
    ],
)
def test_forbidden_arrows_are_found(house, code, message):
    assert forbidden(house(**code), SMALL, {}, []) == [message]


def test_exceptions_lines_apart_and_missing_places(house):
    graph = house(low="import house.top.one")
    arrow = ("house.low.one", "house.top.one")
    assert forbidden(graph, SMALL, {}, [arrow]) == []
    assert forbidden(house(), SMALL, {}, [arrow]) == ["house.low.one no longer imports house.top.one: strike the exception"]
    assert forbidden(house(), "house.top\nhouse.low  house.ground", {}, []) == [
        "house.beside: its room house.beside has no place in LAYERS"
    ]
    assert forbidden({"a": {"b"}, "b": set()}, "a\nb", {}, []) == []
    assert forbidden({"a": {"b"}, "b": set()}, "a\nb", {"a": ("b",)}, []) == ["a imports b, which is not below it"]
