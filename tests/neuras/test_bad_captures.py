"""Captures that cannot work end at once, with a message that says what to do."""

from __future__ import annotations

import gzip
import json
import pickle
import struct
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.ndimage import gaussian_filter, map_coordinates

from pipeline.errors import Reject, UserError
from pipeline.run import run_pipeline
from stages.graphics.cameras import Camera
from stages.neuras.captures import colmap, nerfstudio, pickles
from tests.neuras.test_captures import colmap_model, source_of

SIZE, HEIGHT = (160, 120), 2.0  # pixels; of the cameras over a plane
ORIGIN = np.array([3.0, 2.0, 5.0])  # of the plane: seen from it, other sizes of the flight look the same
GROUND = gaussian_filter(np.random.default_rng(0).normal(size=(1600, 1600)), 1.5)  # 20 texels a unit
GROUND = np.clip(128 + 60 * GROUND / GROUND.std(), 0, 255)


def flight(root: Path, spacing=0.3, count: int = 9, scale=1.0, moved=(0, 0, 0), reach=6.0) -> Path:
    """Photos of a plane from above. scale: of the positions that the file states. moved, reach: of the mesh."""
    (root / "images").mkdir(parents=True)
    frames = []
    for number in range(count):
        pose = np.eye(4)  # looks along -z
        pose[:3, 3] = spacing * (number - (count - 1) / 2), 0.3 * (number % 3), HEIGHT
        camera = Camera.from_fov(*SIZE, 60, pose)
        directions = camera.directions()
        met = camera.position + directions * (HEIGHT / -directions[..., 2:])
        texels = [20 * met[..., axis] + len(GROUND) / 2 for axis in (1, 0)]
        grey = map_coordinates(GROUND, texels, order=1, mode="nearest")
        Image.fromarray(np.repeat(grey[..., None], 3, axis=2).astype(np.uint8)).save(root / f"images/{number}.png")
        pose[:3, 3] = scale * (pose[:3, 3] + ORIGIN)
        frames.append({"file_path": f"images/{number}.png", "transform_matrix": pose.tolist()})
    lens = {"fl_x": camera.fx, "w": SIZE[0], "h": SIZE[1]}
    (root / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    side = np.linspace(-reach, reach, 161)
    x, y = np.meshgrid(side, side)
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1) + ORIGIN + moved
    first = (np.arange(160)[:, None] * 161 + np.arange(160)).ravel()
    faces = np.concatenate([np.stack([first, first + 1, first + 161], 1), np.stack([first + 1, first + 162, first + 161], 1)])
    trimesh.Trimesh(vertices, faces, process=False).export(root / "mesh.ply")
    return root


def edit(root: Path, change) -> None:
    told = json.loads((root / "transforms.json").read_text())
    change(told)
    (root / "transforms.json").write_text(json.dumps(told))


def run(tmp_path: Path, said: list[str] | None = None, **settings):
    capture = {"name": "nerfstudio", "path": str(tmp_path / "set"), **settings}
    root = {"system": "neuras", "stage": "capture", "store": str(tmp_path / "store"), "workers": 0, "capture": capture}
    said = [] if said is None else said
    try:
        return run_pipeline(root, [], out=said.append)["artifacts"]["capture"]
    except UserError as error:
        raise UserError("\n".join([*said, str(error)])) from None


def test_a_good_one_passes(tmp_path):
    flight(tmp_path / "set")
    assert run(tmp_path).ids("train")


def test_two_images(tmp_path):
    flight(tmp_path / "set", count=2)
    with pytest.raises(UserError, match="2 usable frames are too few, at least 3.*take more images"):
        run(tmp_path)


def test_two_images_of_many_that_can_be_read(tmp_path):
    flight(tmp_path / "set")
    for number in range(7):
        (tmp_path / f"set/images/{number}.png").write_bytes(b"no picture")
    with pytest.raises(UserError, match=r"7 unreadable.*more than capture\.max_reject_share=0\.5"):
        run(tmp_path)
    with pytest.raises(UserError, match="2 of 9 frames are left, at least 3 are needed"):
        run(tmp_path, max_reject_share=0.99)
    (tmp_path / "set/images/5.png").write_bytes((tmp_path / "set/images/8.png").read_bytes())  # one trains, two are held out
    (tmp_path / "set/images/0.png").write_bytes((tmp_path / "set/images/8.png").read_bytes())
    (tmp_path / "set/images/8.png").write_bytes(b"no picture")
    assert len(run(tmp_path, max_reject_share=0.99).ids("train")) < 2  # they do not stand at one place


def test_nothing_left_to_score_and_masks_that_hide_all_are_told(tmp_path):
    flight(tmp_path / "set")
    for number in range(1, 9, 2):
        (tmp_path / f"set/images/{number}.png").unlink()
    Image.new("RGBA", SIZE, (0, 0, 0, 255)).save(tmp_path / "set/hidden.png")
    edit(tmp_path / "set", lambda told: told["frames"][4].update(mask_path="hidden.png"))
    said: list[str] = []
    run(tmp_path, said)
    told = "\n".join(said)
    assert "no test frame is left, so nothing can be scored" in told
    assert "masks hide all of 1 frames, such as frame-4" in told


def test_all_the_same_pose(tmp_path):
    def still(told):
        for frame in told["frames"]:
            frame["transform_matrix"] = told["frames"][0]["transform_matrix"]

    edit(flight(tmp_path / "set"), still)
    with pytest.raises(UserError, match="stand at one place.*register the images again"):
        run(tmp_path)


@pytest.mark.parametrize(("scale", "factor"), [(0.001, "1000"), (0.3048, "3.2808"), (100.0, "0.01")])
def test_poses_in_another_unit(tmp_path, scale, factor):
    flight(tmp_path / "set", scale=scale)
    with pytest.raises(UserError, match=f"another unit.*times {factor};"):
        run(tmp_path)


def test_no_overlap(tmp_path):
    flight(tmp_path / "set", spacing=7.0, reach=40.0)
    with pytest.raises(UserError, match="hardly overlap: 0 %.*capture.every"):
        run(tmp_path)


def test_a_mesh_far_from_the_cameras(tmp_path):
    flight(tmp_path / "set", moved=(0, 0, -3000))
    with pytest.raises(UserError, match=r"far from the cameras: \d\d+ times.*one frame and one unit"):
        run(tmp_path)


def test_a_mesh_that_no_camera_sees(tmp_path):
    flight(tmp_path / "set", moved=(500, 0, 0))
    with pytest.raises(UserError, match="no training camera sees the points or the mesh.*contact.png"):
        run(tmp_path)


def test_images_of_another_size(tmp_path):
    root = flight(tmp_path / "set")
    for path in (root / "images").iterdir():
        Image.open(path).resize((80, 60)).save(path)
    with pytest.raises(UserError, match="80 x 60 pixels, its intrinsics are for 160 x 120: multiply.* by 0.5"):
        run(tmp_path)
    for path in (root / "images").iterdir():
        Image.open(path).rotate(90, expand=True).save(path)
    with pytest.raises(UserError, match="the image was cut or turned"):
        run(tmp_path)


# --- headers that claim gigabytes -------------------------------------------------------------------------------------


def big_ply(elements: str) -> bytes:
    return f"ply\nformat binary_little_endian 1.0\n{elements}end_header\n".encode() + bytes(100)


POSITIONS = "property float x\nproperty float y\nproperty float z\n"
BIG_MESH = big_ply(f"element vertex 360000000\n{POSITIONS}element face 4\nproperty list uchar int vertex_indices\n")


def big_png() -> bytes:
    """60,000 x 60,000 pixels in a few bytes."""
    header = b"IHDR" + struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))


def mesh(root):
    (root / "mesh.ply").write_bytes(BIG_MESH)
    source_of(root).mesh()


def image(root):
    (root / "images/0.png").write_bytes(big_png())
    source_of(root).frame("frame-0")


def cloud(root):
    (root / "points.ply").write_bytes(big_ply(f"element vertex 360000000\n{POSITIONS}"))
    nerfstudio.ply_points(root / "points.ply", 4 << 30)


def model(root):
    folder = colmap_model(root / "colmap", True) / "sparse" / "0"
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", 100_000_000) + bytes(60))
    colmap.points(folder, 4 << 30)


def pickled(data):
    def case(root):
        (root / "00.pkl.gz").write_bytes(gzip.compress(data))
        pickles.table(root / "00.pkl.gz")

    return case


BYTES = b"\x80\x05\x96" + struct.pack("<Q", 4 << 30) + b"few."  # a bytearray
MEMO = b"\x80\x02Nr" + struct.pack("<I", 0xFFFFFFF0) + pickle.STOP  # the number of a value


@pytest.mark.parametrize("case", [mesh, image, cloud, model, pickled(BYTES), pickled(MEMO)])
def test_a_header_that_claims_gigabytes_takes_no_memory(tmp_path, case):
    root = flight(tmp_path / "set")
    tracemalloc.start()
    try:
        with pytest.raises((UserError, Reject)):
            case(root)
        assert tracemalloc.get_traced_memory()[1] < 100e6
    finally:
        tracemalloc.stop()
