"""The wheel holds all that a run needs: built, installed elsewhere and run where the checkout is out of reach."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from tests.conftest import ROOT
from tests.test_layers import HOUSE, modules
from tests.test_line import SMALL

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """Built from a copy, since a build leaves a folder that the next one would take files from."""
    source = tmp_path_factory.mktemp("source")
    for name in ("pyproject.toml", "README.md", "LICENSE", "lightmill.py"):
        shutil.copy(ROOT / name, source)
    for name in ("stages", "model", "pipeline", "conf"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    out = tmp_path_factory.mktemp("wheel")
    run([sys.executable, "-m", "pip", "wheel", ".", "--no-deps", "--no-build-isolation", "--no-index", "-q", "-w", out], source)
    (path,) = out.glob("lightmill-*.whl")
    return path


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory) -> Path:
    """An environment with the wheel. It sees the libraries of the running one, but no package that is there by way of a
    .pth file, such as the checkout: Python follows such files in an environment's own folder alone."""
    folder = tmp_path_factory.mktemp("environment")
    run([sys.executable, "-m", "venv", "--without-pip", folder], folder)
    run([sys.executable, "-m", "pip", "--python", folder, "install", "--no-deps", "--no-index", "-q", wheel], folder)
    (packages,) = folder.glob("lib/python*/site-packages")
    libraries = [path for path in sys.path if path.endswith("-packages") and Path(path).is_dir()]
    (packages / "libraries.pth").write_text("".join(f"{path}\n" for path in libraries))
    return folder


@pytest.fixture
def empty(tmp_path) -> Path:
    (folder := tmp_path / "empty").mkdir()
    return folder


def run(words: list, cwd: Path) -> str:
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "PYTHONHOME")}
    done = subprocess.run(list(map(str, words)), cwd=cwd, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_every_file_of_the_house_is_in_it(wheel):
    held = set(zipfile.ZipFile(wheel).namelist())
    data = {path for folder in ("stages", "model", "pipeline") for path in (ROOT / folder).rglob("*.j2")}
    files = {path.relative_to(ROOT).as_posix() for path in {*modules(ROOT, HOUSE).values(), *data}}
    assert files - held == set()
    configs = {f"pipeline/{path.relative_to(ROOT).as_posix()}" for path in (ROOT / "conf").rglob("*.yaml")}
    assert configs and configs - held == set()


def test_the_checkout_is_out_of_reach(installed, empty):
    code = "import lightmill, model, pipeline.hydra_config as h, stages, torch; "
    code += "print(*(m.__file__ for m in (lightmill, model, h, stages)), h.CONF, sep='\\n')"
    paths = run([installed / "bin" / "python", "-c", code], empty).split()
    assert len(paths) == 5
    for path in paths:
        assert Path(path).is_relative_to(installed), path


def test_the_command_answers(installed, empty):
    assert "usage: lightmill" in run([installed / "bin" / "lightmill", "--help"], empty)


def test_from_nothing_to_a_report(installed, empty):
    out = run([installed / "bin" / "lightmill", "run", "stage=evaluate", *SMALL], empty)
    report = Path(out.strip().splitlines()[-1].partition("report.html: ")[2])
    page = (empty / report).read_text()
    assert (empty / report).is_relative_to(empty) and "<img" in page
