"""Captures: every convention by a point whose pixel is known, every fault by its reason."""

from __future__ import annotations

import gzip
import io
import json
import pickle
import re
import struct
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf
from PIL import Image, ImageDraw
from scipy.spatial.transform import Rotation

from pipeline.config import parse
from pipeline.errors import Reject, UserError
from pipeline.run import run_pipeline
from pipeline.store.files import hash_file
from stages.graphics.cameras import Camera
from stages.neuras.captures import actors, colmap, pickles, poses, splits
from stages.neuras.captures.lenses import Lens, undistorted
from stages.neuras.records import CaptureInfo, FrameRecord, PointsRecord, frames, given_mesh, point_sets
from stages.neuras.s00_capture import Capture

ROOT = Path(__file__).resolve().parents[2]
POINT = np.array([0.3, -0.2, 0.4])  # world; where every picture has its white dot
WIDTH, HEIGHT, FX, FY, CX, CY = 160, 120, 130.0, 126.0, 83.0, 57.0
LENSES = {
    "none": {},
    "radial": {"k1": -0.12, "k2": 0.03},
    "all": {"k1": 0.08, "k2": -0.02, "p1": 0.01, "p2": -0.015, "k3": 0.004},
}


def view(number: int) -> tuple[np.ndarray, np.ndarray]:
    """World-to-camera rotation and translation of an OpenCV camera (x right, y down, z ahead) near POINT, z up."""
    angle = 0.5 * number
    position = np.array([4 * np.cos(angle), 4 * np.sin(angle), 1.2])
    ahead = POINT + [0.5, 0.3 * (number % 3), -0.3] - position
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(ahead, right), ahead])
    return rotation, -rotation @ position


def picture(number: int, path: Path, k1=0.0, k2=0.0, p1=0.0, p2=0.0, k3=0.0, size=(WIDTH, HEIGHT)) -> None:
    """A dark image with a white dot where OpenCV's formulas put POINT."""
    rotation, translation = view(number)
    x, y, z = rotation @ POINT + translation
    x, y = x / z, y / z
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = FX * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + CX
    v = FY * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + CY
    columns, rows = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    dot = 20 + 230 * np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / 4)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.repeat(dot[..., None], 3, axis=2).astype(np.uint8)).save(path)


def dot_of(frame) -> np.ndarray:
    """(2,) pixels: the centre of the white dot."""
    weight = np.clip(frame.image()[..., 0].astype(float) - 60, 0, None)
    return (weight[..., None] * frame.camera.pixel_centres()).sum(axis=(0, 1)) / weight.sum()


def nerfstudio(root: Path, count: int = 6, terms: dict | None = None, each=None, **told) -> Path:
    terms = terms or {}
    entries = []
    for number in range(count):
        name = f"images/{number:02d}.png"
        picture(number, root / name, **terms)
        rotation, translation = view(number)
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation.T, -rotation.T @ translation
        entry = {"file_path": name, "transform_matrix": (matrix @ np.diag([1, -1, -1, 1])).tolist()}
        entries.append({**entry, **(each(number) if each else {})})
    intrinsics = {"fl_x": FX, "fl_y": FY, "cx": CX, "cy": CY, "w": WIDTH, "h": HEIGHT, **terms}
    (root / "transforms.json").write_text(json.dumps({**intrinsics, **told, "frames": entries}))
    return root


def edit(root: Path, change) -> None:
    told = json.loads((root / "transforms.json").read_text())
    change(told)
    (root / "transforms.json").write_text(json.dumps(told))


MODELS = {  # parameters, and the same for ``picture``
    "PINHOLE": ([FX, FY, CX, CY], {}),
    "OPENCV": ([FX, FY, CX, CY, 0.08, -0.02, 0.01, -0.015], {"k1": 0.08, "k2": -0.02, "p1": 0.01, "p2": -0.015}),
    "FULL_OPENCV": ([FX, FY, CX, CY, 0.08, -0.02, 0.01, -0.015, 0.004, 0, 0, 0], LENSES["all"]),
}


def colmap_model(root: Path, binary: bool, model: str = "OPENCV", count: int = 6) -> Path:
    parameters, terms = MODELS.get(model, ([FX] * colmap.MODELS[model], {}))
    folder = root / "sparse" / "0"
    folder.mkdir(parents=True)
    rows = []
    for number in range(count):
        picture(number, root / "images" / f"{number:02d}.png", **terms)
        rotation, translation = view(number)
        x, y, z, w = Rotation.from_matrix(rotation).as_quat()
        rows.append((number + 1, w, x, y, z, *translation))
    if binary:
        number = list(colmap.MODELS).index(model)
        (folder / "cameras.bin").write_bytes(
            struct.pack("<QiiQQ", 1, 7, number, WIDTH, HEIGHT) + np.array(parameters, "<f8").tobytes()
        )
        body = struct.pack("<Q", count)
        for row in rows:
            body += struct.pack("<i7di", *row, 7) + f"{row[0] - 1:02d}.png".encode() + b"\0"
            body += struct.pack("<Qddq", 1, 10.5, 20.5, 9)
        (folder / "images.bin").write_bytes(body)
        point = struct.pack("<Q3d3Bd", 9, *POINT, 1, 2, 3, 0.5) + struct.pack("<Qii", 1, 1, 0)
        (folder / "points3D.bin").write_bytes(struct.pack("<Q", 1) + point)
    else:
        words = " ".join(map(str, parameters))
        (folder / "cameras.txt").write_text(f"# comment\n7 {model} {WIDTH} {HEIGHT} {words}\n")
        lines = [" ".join(map(str, row)) + f" 7 {row[0] - 1:02d}.png\n10.5 20.5 9\n" for row in rows]
        lines[2] = lines[2].partition("\n")[0] + "\n\n"  # nothing was found in it
        (folder / "images.txt").write_text("# comment\n" + "".join(lines))
        (folder / "points3D.txt").write_text("9 " + " ".join(map(str, POINT)) + " 1 2 3 0.5 1 0\n")
    return root


def body(value) -> bytes:
    """The opcodes of a value in a pickle, without the frame around them."""
    return pickle.dumps(value, 2)[2:-1]


def old_frame(columns: dict[str, np.ndarray]) -> bytes:
    """A data frame as pandas 0.25 pickles it, of one block per kind of column."""
    kinds = [[name for name in columns if np.asarray(columns[name]).dtype == kind] for kind in (float, object, bool)]
    columns = {name: np.asarray(columns[name]) for names in kinds for name in names}
    blocks, first = b"", 0
    for names in filter(None, kinds):
        blocks += b"}(" + body("values") + body(np.stack([columns[name] for name in names])) + body("mgr_locs")
        blocks += b"c__builtin__\nslice\n(" + body(first) + body(first + len(names)) + body(1) + b"tRu"
        first += len(names)
    index = b"cpandas.core.indexes.base\n_new_Index\n(cpandas.core.indexes.base\nIndex\n}("
    index += body("data") + body(np.array(list(columns), object)) + body("name") + b"NutR"
    told = b"}" + body("0.14.1") + b"}(" + body("axes") + b"](" + index + b"e" + body("blocks") + b"](" + blocks + b"eus"
    manager = b"cpandas.core.internals.managers\nBlockManager\n)\x81((l(l(l" + told + b"tb"
    return b"\x80\x02cpandas.core.frame\nDataFrame\n)\x81}(" + body("_data") + manager + b"ub."


def pandaset(root: Path, count: int = 6, camera: str = "front_camera") -> Path:
    folder, lidar = root / "camera" / camera, root / "lidar"
    folder.mkdir(parents=True)
    lidar.mkdir(exist_ok=True)
    placed = []
    for number in range(count):
        picture(number, folder / f"{number:02d}.jpg")
        rotation, translation = view(number)
        x, y, z, w = Rotation.from_matrix(rotation.T).as_quat()
        position = dict(zip("xyz", -rotation.T @ translation, strict=True))
        placed.append({"position": position, "heading": {"w": w, "x": x, "y": y, "z": z}})
        sweep = old_frame({name: np.array([POINT[axis], float(number)]) for axis, name in enumerate("xyz")})
        (lidar / f"{number:02d}.pkl.gz").write_bytes(gzip.compress(sweep))
    level = {"w": 1, "x": 0, "y": 0, "z": 0}
    sensors = [{"position": {"x": number, "y": 2, "z": 3}, "heading": level} for number in range(count)]
    (folder / "poses.json").write_text(json.dumps(placed))
    (lidar / "poses.json").write_text(json.dumps(sensors))
    (folder / "timestamps.json").write_text(json.dumps([100 + 0.1 * number for number in range(count)]))
    (folder / "intrinsics.json").write_text(json.dumps({"fx": FX, "fy": FY, "cx": CX - 0.5, "cy": CY - 0.5}))
    return root


def new_frame(columns: dict[str, np.ndarray]) -> bytes:
    """A data frame as today's pandas pickles it."""
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame({name: pandas.Series(values, dtype=np.asarray(values).dtype) for name, values in columns.items()})
    frame.columns = pandas.Index(list(frame.columns), dtype=object)
    return pickle.dumps(frame)


# uuid, label, motion, stationary, centre from POINT, size, yaw: of each frame
THINGS = [
    ("parked", "Car", "Parked", True, (0, 0, 0), (0.4, 0.4, 0.4), 0.0),
    ("waiting", "Car", "Stopped", True, (0.8, 0, 0), (0.2, 0.9, 0.3), 0.6),
    ("standing", "Pedestrian", None, True, (-0.7, 0.5, 0), (0.3, 0.3, 0.6), 0.0),
]


def cuboids(root: Path, write=old_frame, things=lambda number: THINGS, count: int = 6) -> Path:
    folder = root / "annotations" / "cuboids"
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        names, labels, motions, still, centres, sizes, yaws = zip(*things(number), strict=True)
        columns = {
            "uuid": np.array(names, object), "label": np.array(labels, object), "yaw": np.array(yaws, float),
            "stationary": np.array(still, bool), "attributes.object_motion": np.array(motions, object),
        }  # fmt: skip
        for axis, name in enumerate("xyz"):
            columns[f"position.{name}"] = POINT[axis] + np.array(centres, float)[:, axis]
            columns[f"dimensions.{name}"] = np.array(sizes, float)[:, axis]
        (folder / f"{number:02d}.pkl.gz").write_bytes(gzip.compress(write(columns)))
    return root


def blendedmvs(root: Path, count: int = 6) -> Path:
    (root / "cams").mkdir(parents=True)
    (root / "cams" / "pair.txt").write_text("1\n0\n1 1 5.0\n")
    for number in range(count):
        picture(number, root / "blended_images" / f"{number:08d}.jpg")
        Image.new("RGB", (WIDTH, HEIGHT)).save(root / "blended_images" / f"{number:08d}_masked.jpg")
        rotation, translation = view(number)
        rows = [*np.column_stack([rotation, translation]).tolist(), [0, 0, 0, 1]]
        intrinsic = [[FX, 0, CX], [0, FY, CY], [0, 0, 1]]
        text = ["extrinsic", *(" ".join(map(str, row)) for row in rows), "", "intrinsic"]
        text += [*(" ".join(map(str, row)) for row in intrinsic), "", "1.5 0.02 128 4.0", ""]
        (root / "cams" / f"{number:08d}_cam.txt").write_text("\n".join(text))
    return root


def nerf_synthetic(root: Path, count: int = 3, size: int = 120) -> Path:
    """White dots over clear pixels, which are black where the alpha channel is dropped."""
    angle = 2 * np.arctan(0.5 * size / FX)
    for split in ("train", "val", "test"):
        entries = []
        for number in range(count):
            rotation, translation = view(number)
            matrix = np.eye(4)
            matrix[:3, :3], matrix[:3, 3] = rotation.T, -rotation.T @ translation
            x, y, z = rotation @ POINT + translation
            centre = np.array([x / z, y / z]) * FX + size / 2
            pixels = np.stack(np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5), axis=-1)
            alpha = 255 * np.exp(-((pixels - centre) ** 2).sum(axis=-1) / 4)
            name = f"{split}/r_{number}"
            (root / split).mkdir(parents=True, exist_ok=True)
            Image.fromarray(np.dstack([np.zeros((size, size, 3)), alpha]).astype(np.uint8)).save(root / f"{name}.png")
            matrix = (matrix @ np.diag([1, -1, -1, 1])).tolist()
            entries.append({"file_path": f"./{name}", "rotation": 0.01, "transform_matrix": matrix})
        (root / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": entries}))
    return root


def source_of(root: Path, name: str = "nerfstudio", **settings):
    stage = Capture()
    config = parse(stage.Config, {"name": name, "path": str(root), **settings}, "capture")
    return stage.open(config, {}, {})


def frames_of(source) -> list:
    return [source.frame(id) for id, group in source.items() if group != "points"]


def assert_dots(source, tolerance: float = 0.12, count: int = 6) -> None:
    """Each picture has its dot where its camera sees POINT; the dots lie apart, so no constant would do."""
    found = frames_of(source)
    assert len(found) == count
    for frame in found:
        assert np.abs(dot_of(frame) - frame.camera.project(POINT)[0]).max() < tolerance, frame.id
    assert np.ptp([dot_of(frame) for frame in found], axis=0).max() > 5


# --- conventions ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lens", LENSES)
def test_nerfstudio_puts_the_point_at_its_pixel(tmp_path, lens):
    source = source_of(nerfstudio(tmp_path, terms=LENSES[lens]))
    assert_dots(source)
    assert (frames_of(source)[0].picture == (tmp_path / "images/00.png").read_bytes()) == (lens == "none")


def test_a_frames_intrinsics_win_over_the_files(tmp_path):
    nerfstudio(tmp_path, each=lambda number: {"cx": CX, "fl_x": FX}, cx=10.0, fl_x=60.0)
    assert_dots(source_of(tmp_path))


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("model", MODELS)
def test_colmap_puts_the_point_at_its_pixel(tmp_path, model, binary):
    source = source_of(colmap_model(tmp_path, binary, model), "colmap")
    assert_dots(source)
    assert np.allclose(source.points("points-sfm").points, [POINT]) and source.info().points == "sfm"
    found = colmap.images(tmp_path / "sparse" / "0")[0]
    assert found.pixels.tolist() == [[10.5, 20.5]] and found.points.tolist() == [9]


def test_colmaps_simple_models_are_those_of_opencv():
    expected = Lens(10, 8, 5.0, 5.0, 4.0, 3.0)
    assert colmap._lens("SIMPLE_PINHOLE", 10, 8, 5, 4, 3) == expected
    assert colmap._lens("SIMPLE_RADIAL", 10, 8, 5, 4, 3, 0.1).radial == (0.1,)
    radial = colmap._lens("RADIAL", "10", "8", "5", "4", "3", "0.1", "0.2")
    assert radial.radial == (0.1, 0.2) and radial.tangential == (0, 0) and (radial.fx, radial.fy) == (5, 5)


def test_pandaset_puts_the_point_at_its_pixel_and_sweeps_keep_out_of_the_test(tmp_path):
    source = source_of(pandaset(tmp_path), "pandaset", mask_actors=False)
    assert_dots(source, tolerance=0.2)  # JPEG
    assert [id for id, group in source.items() if group == "points"] == ["points-00", "points-02", "points-04"]
    sweep = source.points("points-02")
    assert np.allclose(sweep.points, [POINT, [2, 2, 2]]) and sweep.sensor.tolist() == [2, 2, 3]
    info = source.info()
    assert (info.units, info.metre, info.up, info.points) == ("metre", 1.0, (0, 0, 1), "lidar")
    assert source.frame("frame-03").time == pytest.approx(100.3)


def test_several_cameras_of_pandaset_share_the_split_of_a_moment(tmp_path):
    pandaset(tmp_path)
    pandaset(tmp_path, camera="back_camera")
    source = source_of(tmp_path, "pandaset", cameras=["front_camera", "back_camera"], mask_actors=False)
    groups = dict(source.items())
    assert len(source.shots) == 12 and groups["frame-front_camera-01"] == groups["frame-back_camera-01"] == "test"
    assert all(groups[f"frame-front_camera-{n:02d}"] == groups[f"frame-back_camera-{n:02d}"] for n in range(6))
    with pytest.raises(UserError, match="no camera 'left'; it has back_camera, front_camera"):
        source_of(tmp_path, "pandaset", cameras=["left"])


@pytest.mark.parametrize("lens", ["none", "all"])
def test_smaller_pictures_take_their_camera_along(tmp_path, lens):
    source = source_of(nerfstudio(tmp_path, terms=LENSES[lens]), max_side=80)
    assert frames_of(source)[0].image().shape == (60, 80, 3)
    assert_dots(source)


def test_pixels_that_the_lens_never_saw_do_not_count(tmp_path):
    source = source_of(nerfstudio(tmp_path, terms={"k1": 0.3}))
    counts = source.frame("frame-00").counts()
    assert 0.3 < counts.mean() < 0.95 and counts[57, 83] and not counts[0, 0]


def test_what_lies_beyond_a_lens_fold_is_not_in_the_picture():
    lens = Lens(200, 200, 60.0, 60.0, 100.0, 100.0, (-0.2,))  # folds at r = sqrt(1 / 0.6) = 1.29
    _, inside = undistorted(np.full((200, 200, 3), 9, np.uint8), lens)
    radius = np.linalg.norm(lens.camera(np.eye(4)).pixel_centres() - 100, axis=-1) / 60
    assert inside[radius < 1.25].all() and not inside[radius > 1.32].any()


def test_masks_follow_their_pictures(tmp_path):
    nerfstudio(tmp_path, each=lambda number: {"mask_path": f"masks/{number}.png"})
    (tmp_path / "masks").mkdir()
    for number in range(6):
        mask = Image.new("L", (WIDTH, HEIGHT), 255)
        ImageDraw.Draw(mask).rectangle((0, 0, 40, 58), fill=0)
        mask.save(tmp_path / "masks" / f"{number}.png")
    full, small = source_of(tmp_path).frame("frame-01").counts(), source_of(tmp_path, max_side=80).frame("frame-01").counts()
    expected = np.ones((HEIGHT, WIDTH), bool)
    expected[:59, :41] = False
    assert np.array_equal(full, expected)
    expected[:60, :42] = False  # one of four pixels is enough
    assert np.array_equal(small, expected[::2, ::2])


def test_masks_go_through_the_lens_with_their_pictures(tmp_path):
    """Mask and image hold the same square; after the lens they still do."""
    nerfstudio(tmp_path, terms={"k1": -0.3}, each=lambda number: {"mask_path": f"masks/{number}.png"})
    (tmp_path / "masks").mkdir()
    for number in range(6):
        square = Image.new("L", (WIDTH, HEIGHT), 255)
        ImageDraw.Draw(square).rectangle((8, 8, 40, 40), fill=0)
        square.save(tmp_path / "masks" / f"{number}.png")
        square.convert("RGB").save(tmp_path / "images" / f"{number:02d}.png")
    frame = source_of(tmp_path).frame("frame-00")
    white = frame.image()[..., 0] == 255
    assert np.array_equal(frame.counts(), white) and (~white).sum() > 200 and not np.array_equal(~white[8:41, 8:41], True)


# --- splits, units, up ------------------------------------------------------------------------------------------------


def test_splits_are_those_that_the_set_names(tmp_path):
    names = [f"images/{number:02d}.png" for number in range(6)]
    nerfstudio(tmp_path, train_filenames=names[:3], val_filenames=names[3:4], test_filenames=names[4:5])
    source = source_of(tmp_path)
    assert [group for _, group in source.items()] == ["train"] * 3 + ["validation", "test"]  # the sixth is in no list
    assert "names" in source.info().split_rule
    assert dict(source_of(tmp_path, split="every_other").items())["frame-01"] == "test"
    thin = [group for _, group in source_of(tmp_path, split="every_nth", nth=3).items()]
    assert thin == ["train", "test", "test", "train", "test"]


def test_rules_of_splits():
    moments, none = list(range(20)), [None] * 20
    found, said = splits.assigned(moments, none, splits.Rule())
    assert found[1::2] == ["test"] * 10 and [i for i in range(20) if found[i] == "validation"] == [4, 14]
    assert "every other" in said and "validation" in said
    halves = [splits.assigned(moments, none, splits.Rule("random_half", seed))[0] for seed in (0, 0, 1)]
    assert halves[0] == halves[1] != halves[2] and halves[0].count("test") == 10
    found, said = splits.assigned(moments, ["test"] * 20, splits.Rule("every_nth", nth=8))  # whatever the set names
    assert [i for i in range(20) if found[i] == "train"] == [0, 8, 16] and found.count("test") == 15
    assert [i for i in range(20) if found[i] == "validation"] == [6, 18] and "one frame in 8" in said and "held-out" in said
    assert splits.kept(["train", "test"] * 6, 3) == [0, 1, 6, 7] and splits.kept(none, 8) == [0, 8, 16]


def test_thinning_takes_frames_out(tmp_path):
    source = source_of(nerfstudio(tmp_path), every=2)
    assert [id for id, _ in source.items()] == ["frame-00", "frame-02", "frame-04"] and "one in 2" in source.info().split_rule


def test_units_are_arbitrary_unless_somebody_says_metres(tmp_path):
    info = source_of(nerfstudio(tmp_path)).info()
    assert info.units == "arbitrary" and info.metre == pytest.approx(info.radius / 100)
    assert "does not say" in info.source["units_from"]
    info = source_of(tmp_path, units="metre").info()
    assert (info.units, info.metre, info.source["units_from"]) == ("metre", 1.0, "capture.units")
    edit(tmp_path, lambda told: told.update(units="metre"))
    assert source_of(tmp_path).info().units == "metre"
    assert source_of(tmp_path, units="arbitrary").info().metre < 1


def test_up_is_the_sets_or_that_of_level_cameras(tmp_path):
    info = source_of(nerfstudio(tmp_path)).info()
    assert np.allclose(info.up, [0, 0, 1], atol=1e-6) and "cameras" in info.source["up_from"]
    assert source_of(tmp_path, up="-y").info().up == (0, -1, 0)


@pytest.mark.parametrize("up", [[0, 0, 1.0], [0, 0, -1.0], [0.6, 0, 0.8]])
@pytest.mark.parametrize("kind", ["around", "drive", "strips"])
def test_upward(up, kind):
    up = np.array(up)
    side = np.cross(up, [0, 1.0, 0])
    side /= np.linalg.norm(side)
    level = np.stack([side, np.cross(up, side)])
    headings = {"around": np.arange(8) * 0.7, "drive": np.linspace(-0.05, 0.05, 8), "strips": np.pi * np.arange(8)}[kind]
    cameras = []
    for heading in headings:
        ahead = np.array([np.cos(heading), np.sin(heading)]) @ level
        right = np.cross(ahead, up)
        back, above = (up, ahead) if kind == "strips" else (-ahead, up)  # strips: straight down
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, above, back], axis=1)
        assert np.linalg.det(pose[:3, :3]) > 0.99
        cameras.append(Camera.from_fov(8, 8, 60, pose))
    assert poses.upward(cameras) @ up > 0.999


def test_the_ball_holds_what_cameras_see():
    camera = Camera.from_fov(8, 8, 90, np.eye(4))  # looks along -z
    seen = np.stack(np.meshgrid([-1.0, 1.0], np.linspace(-1, 1, 100), [-4.0]), axis=-1).reshape(-1, 3)
    centre, radius = poses.ball([camera], seen)
    assert np.allclose(centre, [0, 0, -2], atol=0.05) and radius == pytest.approx(np.sqrt(6), abs=0.05)
    stray = np.repeat([[0, 0, 50.0], [80, 0, -1]], 50, axis=0)  # behind it, and beside its picture
    assert poses.ball([camera], np.concatenate([seen, stray]))[1] == radius
    far = np.concatenate([seen, [[0, 0, -900.0]]])  # seen, and alone
    assert poses.ball([camera], far)[1] < 3
    assert poses.ball([camera], np.zeros((0, 3)))[1] == 1.0
    assert poses.in_view([camera], np.concatenate([seen, stray])).sum() == len(seen)


# --- the paper's other sets -------------------------------------------------------------------------------------------


def test_blendedmvs_puts_the_point_at_its_pixel_and_its_tiles_together(tmp_path):
    import trimesh

    root = blendedmvs(tmp_path / "set")
    for number in range(2):
        tile = root / "textured_mesh" / f"tile_{number}" / "model.obj"
        tile.parent.mkdir(parents=True)
        trimesh.creation.box(bounds=[[number, 0, 0], [number + 1, 1, 1]]).export(tile)
    source = source_of(root, "blendedmvs")
    assert_dots(source)
    groups = [group for _, group in source.items()]
    assert "random half" in source.info().split_rule and groups.count("test") == 3 and source.info().units == "arbitrary"
    mesh = source.mesh()
    assert mesh.faces.shape == (24, 3) and mesh.vertices[:, 0].max() == 2 and mesh.faces.max() == 15
    given = source_of(root, "blendedmvs", mesh=str(root / "textured_mesh" / "tile_1")).mesh()
    assert given.faces.shape == (12, 3) and given.vertices[:, 0].min() == 1


def test_blendedmvs_says_what_is_wrong(tmp_path):
    with pytest.raises(UserError, match="no cams/NNNNNNNN_cam.txt"):
        source_of(tmp_path, "blendedmvs")
    root = blendedmvs(tmp_path / "set")
    camera = root / "cams" / "00000002_cam.txt"
    camera.write_text(camera.read_text().replace("intrinsic", "nothing"))
    Image.new("RGB", (40, 30)).save(root / "blended_images" / "00000003.jpg")  # of another resolution
    (root / "blended_images" / "00000004.jpg").unlink()
    shots = source_of(root, "blendedmvs").shots
    reasons = {id: shot.fault.reason for id, shot in shots.items() if shot.fault}
    assert list(reasons.values()) == ["no_pose", "no_intrinsics", "no_image"]
    with pytest.raises(UserError, match="neither a mesh nor a folder"):
        source_of(root, "blendedmvs", mesh=str(root / "cams"))


def test_nerf_synthetic_is_shown_over_white_in_its_splits(tmp_path):
    source = source_of(nerf_synthetic(tmp_path), "nerf_synthetic")
    assert [group for _, group in source.items()] == ["train"] * 3 + ["validation"] * 3 + ["test"] * 3
    assert source.info().up == (0, 0, 1) and source.mesh() is None
    for frame in frames_of(source):
        image = frame.image()
        darkest = np.array(np.unravel_index(image[..., 0].argmin(), image.shape[:2]))[::-1] + 0.5
        assert np.abs(darkest - frame.camera.project(POINT)[0]).max() < 1 and frame.mask is None
        assert image.min() < 60 and np.median(image) == 255


def test_nerf_synthetic_says_what_is_wrong(tmp_path):
    with pytest.raises(UserError, match="no transforms_train.json"):
        source_of(tmp_path, "nerf_synthetic")
    root = nerf_synthetic(tmp_path)
    path = root / "transforms_train.json"
    path.write_text(path.read_text().replace("camera_angle_x", "angle"))
    with pytest.raises(UserError, match="3 no_intrinsics.*camera_angle_x"):
        source_of(root, "nerf_synthetic")


# --- faults -----------------------------------------------------------------------------------------------------------


def turned(change):
    def apply(entry, root):
        matrix = np.array(entry["transform_matrix"])
        change(matrix)
        entry["transform_matrix"] = matrix.tolist()

    return apply


def mirror(matrix):
    matrix[:3, 0] *= -1


def scale(matrix):
    matrix[:3, :3] *= 1.7


def shear(matrix):
    matrix[:3, 0] = (matrix[:3, 0] + 0.1 * matrix[:3, 1]) / np.sqrt(1.01)


def blank(matrix):
    matrix[1, 3] = np.nan


def write(name, data):
    return lambda entry, root: (root / entry["file_path"]).write_bytes(data) if name is None else entry.update(file_path=name)


def small_image(entry, root):
    Image.new("RGB", (80, 60)).save(root / entry["file_path"])


def deep_image(entry, root):
    Image.fromarray(np.zeros((HEIGHT, WIDTH), np.uint16)).save(root / entry["file_path"])


def small_mask(entry, root):
    Image.new("L", (80, 60)).save(root / "m.png")
    entry["mask_path"] = "m.png"


FAULTS = {
    "no_pose": lambda entry, root: entry.pop("transform_matrix"),
    "no_pose ": lambda entry, root: entry.update(transform_matrix=[[1, 0], [0, 1]]),
    "left_handed": turned(mirror),
    "scaled": turned(scale),
    "not_rigid": turned(shear),
    "not_finite": turned(blank),
    "no_intrinsics": lambda entry, root: entry.update(fl_x=-3),
    "no_intrinsics ": lambda entry, root: entry.update(fl_x="wide"),
    "no_image": write("images/none.png", b""),
    "no_mask": lambda entry, root: entry.update(mask_path="masks/none.png"),
    "unsafe_path": write("../outside.png", b""),
    "unsafe_path ": write("/etc/passwd", b""),
    "unreadable": write(None, b"\x89PNG no picture"),
    "unreadable ": deep_image,
    "size": small_image,
    "mask_size": small_mask,
}


@pytest.mark.parametrize("reason", FAULTS)
def test_a_frames_fault_has_its_reason_and_spares_the_others(tmp_path, reason):
    root = nerfstudio(tmp_path / "set")
    (tmp_path / "outside.png").write_bytes((root / "images/00.png").read_bytes())
    edit(root, lambda told: FAULTS[reason](told["frames"][3], root))
    source = source_of(root)
    told = {}
    for id, _ in source.items():
        try:
            source.frame(id)
        except Reject as reject:
            told[id] = reject.reason
    assert list(told.values()) == [reason.strip()] and reason.strip() in Capture.reasons


def test_integers_of_hundreds_of_digits_are_a_frames_fault(tmp_path):
    huge = 10**400
    change = {1: {"transform_matrix": [[huge] * 4] * 4}, 3: {"w": huge}, 5: {"time": huge}}
    source = source_of(nerfstudio(tmp_path, each=lambda number: change.get(number, {})))
    reasons = {id: shot.fault.reason for id, shot in source.shots.items() if shot.fault}
    assert reasons == {"frame-01": "no_pose", "frame-03": "no_intrinsics"}


def test_a_picture_over_the_limit_is_not_decoded(tmp_path):
    with pytest.raises(Reject, match="capture.max_pixels=1000"):
        source_of(nerfstudio(tmp_path), max_pixels=1000).frame("frame-00")


def test_links_that_lead_out_are_not_followed(tmp_path):
    root = nerfstudio(tmp_path / "set")
    secret = tmp_path / "secret.png"
    (root / "images/02.png").rename(secret)
    (root / "images/02.png").symlink_to(secret)
    with pytest.raises(Reject) as caught:
        source_of(root).frame("frame-02")
    assert caught.value.reason == "unsafe_path"


@pytest.mark.parametrize(("name", "file"), [
    ("nerfstudio", "transforms.json"), ("colmap", "sparse/0/cameras.bin"), ("pandaset", "camera/front_camera/poses.json"),
])  # fmt: skip
def test_a_sets_own_files_are_not_read_elsewhere(tmp_path, name, file):
    root = tmp_path / "set"
    {"nerfstudio": nerfstudio, "pandaset": pandaset, "colmap": lambda root: colmap_model(root, True)}[name](root)
    settings = {"mask_actors": False} if name == "pandaset" else {}
    source_of(root, name, **settings)
    (root / file).rename(tmp_path / "elsewhere")
    (root / file).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(UserError, match="has no|leads out"):
        source_of(root, name, **settings)


def test_whole_captures_that_cannot_be_read_say_why(tmp_path):
    with pytest.raises(UserError, match="has no transforms.json"):
        source_of(tmp_path)
    with pytest.raises(UserError, match="no model of COLMAP"):
        source_of(tmp_path, "colmap")
    with pytest.raises(UserError, match="no camera 'front_camera'; it has none"):
        source_of(tmp_path, "pandaset")
    (tmp_path / "transforms.json").write_text("{")
    with pytest.raises(UserError, match="needs a list 'frames'"):
        source_of(tmp_path)
    nerfstudio(tmp_path, camera_model="OPENCV_FISHEYE")
    with pytest.raises(UserError, match="'OPENCV_FISHEYE' is not read"):
        source_of(tmp_path)
    nerfstudio(tmp_path, fl_x=0)
    with pytest.raises(UserError, match="no training frame is usable.*6 no_intrinsics"):
        source_of(tmp_path)
    nerfstudio(tmp_path, each=lambda number: {"file_path": "images/00.png"})
    with pytest.raises(UserError, match=r"names 'images/00.png' twice"):
        source_of(tmp_path)
    nerfstudio(tmp_path, train_filenames=["other/00.png"])
    with pytest.raises(UserError, match="name none of its frames"):
        source_of(tmp_path)
    nerfstudio(tmp_path, count=0)
    with pytest.raises(UserError, match="holds no frame"):
        source_of(tmp_path)


def test_other_lenses_of_colmap_are_refused_by_name(tmp_path):
    with pytest.raises(UserError, match="OPENCV_FISHEYE is not read.*image_undistorter"):
        source_of(colmap_model(tmp_path, True, "OPENCV_FISHEYE"), "colmap")


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_truncated_models_are_told(tmp_path, name):
    path = colmap_model(tmp_path, True) / "sparse" / "0" / name
    whole = path.read_bytes()
    for data in (whole[:-3], struct.pack("<Q", 1 << 60) + whole[8:]):
        path.write_bytes(data)
        with pytest.raises((UserError, Reject), match="early|entries"):
            source_of(tmp_path, "colmap").points("points-sfm")


# --- things that move -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("write", [old_frame, new_frame])
def test_what_moves_does_not_count_and_leaves_no_point(tmp_path, write):
    root = cuboids(pandaset(tmp_path), write)
    source = source_of(root, "pandaset")
    counted = {name: [] for name, *_ in THINGS}
    for frame in frames_of(source):
        counts = frame.counts()
        for name, _, _, _, centre, _, _ in THINGS:
            x, y = frame.camera.project(POINT + centre)[0].astype(int)
            if 0 <= x < WIDTH and 0 <= y < HEIGHT:
                counted[name].append(bool(counts[y, x]))
        assert 0.01 < 1 - counts.mean() < 0.5
    assert any(counted["parked"]) and min(map(len, counted.values())) > 2  # others stand before it in some views
    assert not any(counted["waiting"] + counted["standing"])
    assert len(source.points("points-00").points) == 2  # the parked car's point stays
    assert all(frame.mask is None for frame in frames_of(source_of(root, "pandaset", mask_actors=False)))


def test_what_moves_once_is_an_actor_always(tmp_path):
    def things(number):
        return [("car", "Car", "Moving" if number == 5 else "Parked", number != 5, (0, 0, 0), (0.4, 0.4, 0.4), 0.0)]

    source = source_of(cuboids(pandaset(tmp_path), things=things), "pandaset")
    x, y = frames_of(source)[0].camera.project(POINT)[0].astype(int)
    assert not frames_of(source)[0].counts()[y, x]
    assert source.points("points-00").points.tolist() == [[0, 0, 0]]  # POINT lay on the car


def test_a_boxs_outline_holds_what_is_in_it_alone():
    box = actors.Box((0.3, 0.2, -4.0), (1.0, 2.0, 0.5), 0.7)
    points = np.random.default_rng(0).uniform(-3, 3, (4000, 3)) + box.centre
    within = actors.inside(points, [box])
    assert 0.001 < within.mean() < 0.05
    turned = (points - box.centre) @ Rotation.from_rotvec([0, 0, 0.7]).as_matrix()  # into the box's own axes
    assert (within == (np.abs(turned) <= [0.5, 1.0, 0.25]).all(axis=1)).all()
    camera = Camera.from_fov(64, 48, 60, np.eye(4))
    polygon = actors.outline(box, camera)
    picture = Image.new("L", (64, 48))
    ImageDraw.Draw(picture).polygon([tuple(point) for point in polygon], fill=1)
    columns, rows = camera.project(points[within])[0].astype(int).T
    assert np.array(picture)[rows, columns].mean() > 0.98 and 0.02 < np.array(picture).mean() < 0.2
    assert actors.outline(actors.Box((0, 0, 4.0), (1, 1, 1), 0), camera) is None  # behind
    assert actors.outline(actors.Box((30, 0, -4.0), (1, 1, 1), 0), camera) is None  # beside
    around = actors.outline(actors.Box((0, 0, 0), (2, 2, 2), 0), camera)  # the camera is in it
    assert around.min() < 0 and around.max() > 64


@pytest.mark.parametrize("fault", ["hostile", "column"])
def test_boxes_that_cannot_be_read_stop_the_run_and_can_be_left_out(tmp_path, fault):
    root = cuboids(pandaset(tmp_path))
    data = pickle.dumps(Hostile()) if fault == "hostile" else old_frame({"uuid": np.array(["a"], object)})
    (root / "annotations/cuboids/03.pkl.gz").write_bytes(gzip.compress(data))
    with pytest.raises(UserError, match="capture.mask_actors=false"):
        source_of(root, "pandaset")
    source_of(root, "pandaset", mask_actors=False)


def test_boxes_that_are_missing_stop_the_run_and_can_be_left_out(tmp_path):
    root = cuboids(pandaset(tmp_path))
    (root / "annotations/cuboids/03.pkl.gz").unlink()
    with pytest.raises(UserError, match=r"cuboids/03\.pkl\.gz.*capture.mask_actors=false"):
        source_of(root, "pandaset")
    source_of(root, "pandaset", mask_actors=False)


def test_images_of_pandaset_that_were_made_smaller_are_told(tmp_path):
    root = cuboids(pandaset(tmp_path))
    folder = root / "camera/front_camera"
    (folder / "intrinsics.json").write_text(json.dumps({"fx": 1970.0, "fy": 1970.0, "cx": 970.0, "cy": 483.3}))
    for path in folder.glob("*.jpg"):
        Image.new("RGB", (1728, 972)).save(path)
    with pytest.raises(UserError, match="made smaller than the set's 1920 x 1080"):
        source_of(root, "pandaset")


def test_a_place_far_from_the_origin_is_moved_to_it(tmp_path):
    """Coordinates of a map of the earth, which float32 would round to half a metre."""
    east = np.array([500_000.0, 4_200_000.0, 120.0])

    def away(told):
        for entry in told["frames"]:
            matrix = np.array(entry["transform_matrix"])
            matrix[:3, 3] += east
            entry["transform_matrix"] = matrix.tolist()

    def line(point):
        return " ".join(f"{value:.6f}" for value in point) + "\n"

    def written(root, origin):
        corners = [POINT + origin + offset for offset in ([0, 0, 0], [20.013, 0, 0], [0, 15.017, 0])]
        (root / "mesh.obj").write_text("".join(f"v {line(corner)}" for corner in corners) + "f 1 2 3\n")
        told = ["ply", "format ascii 1.0", "element vertex 1", *(f"property double {axis}" for axis in "xyz"), "end_header"]
        (root / "sparse_pc.ply").write_text("\n".join(told) + "\n" + line(POINT + origin))
        return root

    near, far = (written(nerfstudio(tmp_path / name), origin) for name, origin in (("near", 0), ("far", east)))
    edit(far, away)
    here, there = source_of(near), source_of(far)
    origin = there.info().source["origin"]
    assert np.abs(np.array(origin) - east).max() < 5 and "origin" not in here.info().source
    apart = east - origin
    for a, b in zip(frames_of(here), frames_of(there), strict=True):
        assert np.allclose(a.camera.position + apart, b.camera.position, atol=1e-6)
    assert np.allclose(here.mesh().vertices + apart, there.mesh().vertices, atol=1e-5)
    points = [source.points(next(id for id, group in source.items() if group == "points")).points for source in (here, there)]
    assert np.allclose(points[0] + apart, points[1], atol=1e-5)
    assert there.info().radius == pytest.approx(here.info().radius, rel=1e-5)
    keys = [source.hashes(lambda path: "content")["told"] for source in (here, there)]
    assert keys[0] != keys[1] and keys[1]["origin"] == origin  # points would stay behind their cameras


def test_boxes_are_part_of_the_key(tmp_path):
    root, stage = cuboids(pandaset(tmp_path), things=lambda number: THINGS[:1]), Capture()

    def items():
        return stage.identity(parse(stage.Config, {"name": "pandaset", "path": str(root)}, "capture"), hash_file)["items"]

    before = items()
    cuboids(root)
    changed = {id for id, value in items().items() if before[id] != value}
    assert changed == set(before)


# --- strangers' pickles -----------------------------------------------------------------------------------------------


class Hostile:
    def __reduce__(self):
        return (__import__("os").system, ("touch /tmp/lightmill_was_here",))


@pytest.mark.parametrize(
    "data",
    [
        pickle.dumps(Hostile()),
        pickle.dumps({"x": 1}),
        pickle.dumps(np.arange(3)),
        b"\x80\x02cbuiltins\neval\n(" + body("1") + b"tR.",
        b"\x80\x04\x8c\x06pandas\x8c\x13DataFrame.__class__\x93.",
        b"\x80\x02c__builtin__\nslice\n}" + body("__call__") + body(1) + b"sb.",  # a state for a name itself
        old_frame({"x": np.zeros(3)})[:-20],
        b"",
    ],
)
def test_a_pickle_that_is_no_table_is_refused(tmp_path, data):
    path = tmp_path / "00.pkl.gz"
    path.write_bytes(gzip.compress(data))
    with pytest.raises(Reject) as caught:
        pickles.table(path)
    assert caught.value.reason == "unreadable"


def test_tables_of_todays_pandas_are_read(tmp_path):
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame({"x": [1.5, 2.5], "n": [3, 4], "name": np.array(["a", "b"], object), "y": [5.5, 6.5]})
    frame = frame.astype({"name": object})
    frame.columns = pandas.Index(list(frame.columns), dtype=object)
    frame.to_pickle(tmp_path / "00.pkl.gz")
    found = pickles.table(tmp_path / "00.pkl.gz")
    assert {name: values.tolist() for name, values in found.items()} == {
        "x": [1.5, 2.5], "n": [3, 4], "y": [5.5, 6.5], "name": ["a", "b"],
    }  # fmt: skip


def test_a_pickle_that_unpacks_without_end_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(pickles, "MAX_BYTES", 1000)
    (tmp_path / "00.pkl.gz").write_bytes(gzip.compress(bytes(5000)))
    with pytest.raises(Reject, match="over 1000 bytes"):
        pickles.table(tmp_path / "00.pkl.gz")


# --- the stage --------------------------------------------------------------------------------------------------------


def run(tmp_path: Path, **settings):
    capture = {"name": "nerfstudio", "path": str(tmp_path / "set"), **settings}
    root = {"system": "neuras", "stage": "capture", "store": str(tmp_path / "store"), "workers": 0, "capture": capture}
    said: list[str] = []
    return run_pipeline(root, [], out=said.append)["artifacts"]["capture"], said


def test_the_stage_writes_frames_points_mesh_and_facts(tmp_path):
    import trimesh

    root = nerfstudio(tmp_path / "set")
    trimesh.PointCloud(np.random.default_rng(0).normal(size=(50, 3))).export(root / "sparse_pc.ply")
    trimesh.creation.icosphere(subdivisions=2).export(root / "mesh.ply")
    edit(root, lambda told: turned(scale)(told["frames"][5], root))
    artifact, _ = run(tmp_path)
    assert [frame.id for frame in frames(artifact, "test")] == ["frame-01", "frame-03"]
    assert [frame.split for frame in frames(artifact)] == ["train", "test", "train", "test", "validation"]
    assert [len(record.points) for record in point_sets(artifact)] == [50]
    assert len(given_mesh(artifact).faces) == 320
    info = CaptureInfo.of(artifact)
    assert info.points == "sfm" and info.units == "arbitrary" and 2 < info.radius < 8
    with Image.open(artifact.file("contact.png")) as sheet:
        assert sheet.width > 1000 and len(np.unique(np.array(sheet.convert("L")))) > 50
    assert artifact.manifest["outputs"]["rejects"] == {"scaled": 1}


def test_only_what_changed_is_made_again(tmp_path):
    root = nerfstudio(tmp_path / "set")
    first, _ = run(tmp_path)
    picture(9, root / "images" / "02.png")
    second, said = run(tmp_path)
    assert first.key != second.key and any("5 of them already there" in line for line in said)
    changed = [row.id for row in first.rows() if first.digest_of(row.id) != second.digest_of(row.id)]
    assert changed == ["frame-02"]
    assert run(tmp_path, units="metre")[0].key != second.key
    moved = tmp_path / "moved"
    root.rename(moved)
    assert run(tmp_path, path=str(moved))[0].key == second.key


def test_the_mesh_is_part_of_the_key(tmp_path):
    import trimesh

    nerfstudio(tmp_path)
    stage = Capture()

    def identity():
        return stage.identity(parse(stage.Config, {"name": "nerfstudio", "path": str(tmp_path)}, "capture"), hash_file)

    before = identity()
    trimesh.creation.icosphere(subdivisions=1).export(tmp_path / "mesh.ply")
    assert before["mesh"] is None and identity()["mesh"] is not None and before["items"] == identity()["items"]


class FakeSource:
    """A source that lies in no folder."""

    def items(self):
        return [("frame-a", "train"), ("frame-b", "test"), ("points-a", "points")]

    def frame(self, id):
        buffer = io.BytesIO()
        Image.new("RGB", (8, 6), (200, 10, 10)).save(buffer, "PNG")
        camera = Camera.from_fov(8, 6, 60, np.eye(4))
        return FrameRecord(id, camera, buffer.getvalue(), dict(self.items())[id], shift=1.5, depth=np.full((6, 8), 2.5))

    def points(self, id):
        return PointsRecord(id, np.array([[0, 0, -2.0]]), np.zeros(3))

    def mesh(self):
        return None

    def info(self):
        return CaptureInfo("metre", 1.0, (0.0, 1.0, 0.0), (0.0, 0.0, -1.0), 3.0, "lidar", "b is test")


def test_the_stage_only_dispatches(tmp_path, monkeypatch):
    from stages.neuras import s00_capture

    nerfstudio(tmp_path / "set")
    monkeypatch.setattr(s00_capture, "_source", lambda config, prepared=None: FakeSource())
    monkeypatch.setattr(Capture, "identity", lambda self, config, hash_file: {})
    artifact, _ = run(tmp_path)
    found = {frame.id: (frame.split, frame.shift, float(frame.depth[0, 0])) for frame in frames(artifact)}
    assert found == {"frame-a": ("train", 1.5, 2.5), "frame-b": ("test", 1.5, 2.5)}
    assert [record.sensor.tolist() for record in point_sets(artifact)] == [[0, 0, 0]] and given_mesh(artifact) is None
    assert CaptureInfo.of(artifact).split_rule == "b is test" and artifact.manifest["summary"]["summary"]["points"] == 1


@pytest.mark.parametrize("path", sorted((ROOT / "conf/neuras/capture").glob("*.yaml")), ids=lambda path: path.stem)
def test_every_variants_settings_exist_and_are_the_defaults_but_for_what_it_says(path):
    folder = path.stem != "street"
    shared = OmegaConf.load(path.parent / "common/default.yaml") if folder else {}
    given = OmegaConf.to_container(OmegaConf.merge({"seed": 0}, shared, OmegaConf.load(path)), resolve=False)
    given.pop("defaults", None)
    config = parse(Capture.Config, {**given, "seed": 0}, "capture")
    assert config.name == path.stem
    other = {name for name, value in config if value != type(config).model_fields[name].get_default(call_default_factory=True)}
    assert other == ({"max_side"} if path.stem in ("pandaset", "images") else set())
    assert config.split == "random_half" if path.stem == "blendedmvs" else folder is False or config.split == "auto"


def test_every_reason_is_told_to_users():
    page = (ROOT / "docs/neuras/captures.md").read_text()
    told = set(re.findall(r"`(\w+)`", "".join(re.findall(r"^\| (`.*?) \|", page, flags=re.MULTILINE))))
    assert told == set(Capture.reasons)


# --- real captures ----------------------------------------------------------------------------------------------------


def real(shared_data: Path, name: str) -> Path:
    path = shared_data / "captures" / name
    if not path.is_dir():
        pytest.skip(f"no capture at {path}")
    return path


def test_colmaps_own_tracks_meet_their_pixels(shared_data):
    folder = real(shared_data, "caliterra-colmap") / "sparse" / "0"
    numbers, positions = colmap.points(folder, 1 << 30)
    where = dict(zip(numbers.tolist(), positions, strict=True))
    lenses, errors = colmap.cameras(folder), []
    for image in colmap.images(folder):
        lens = lenses[image.camera]
        seen = image.points >= 0
        points = np.array([where[number] for number in image.points[seen].tolist()])
        focal, centre = np.array([lens.fx, lens.fy]), np.array([lens.cx, lens.cy])
        ideal = (lens.camera(colmap.camera_to_world(image)).project(points)[0] - centre) / focal
        errors.append(np.linalg.norm(lens.distort(ideal) * focal + centre - image.pixels[seen], axis=1))
    errors = np.concatenate(errors)
    assert len(errors) > 50_000 and errors.mean() < 0.6


def test_both_forms_of_the_drone_flight_show_the_same(shared_data):
    """One was undistorted by COLMAP, the other is by us."""
    from stages.neuras.captures.lenses import bilinear

    ours = source_of(real(shared_data, "caliterra-colmap"), "colmap").frame("frame-IMG_9400")
    source = source_of(real(shared_data, "caliterra"))
    given, info = source.frame("frame-IMG_9400"), source.info()
    assert np.allclose(ours.camera.camera_to_world, given.camera.camera_to_world)
    a, b = given.camera, ours.camera
    pixels = (a.pixel_centres() - [a.cx, a.cy]) / [a.fx, a.fy] * [b.fx, b.fy] + [b.cx, b.cy]
    shown = bilinear(ours.image(), pixels)
    difference = np.abs(shown - given.image()).mean()
    assert difference < 1.5 and np.abs(np.roll(shown, 1, axis=1) - given.image()).mean() > 1.8 * difference
    assert info.up[2] < -0.98 and info.metre == pytest.approx(info.radius / 100)  # its z points down


def test_both_forms_of_the_real_street_have_the_same_cameras(shared_data):
    native = source_of(real(shared_data, "panda002-native"), "pandaset", max_side=640)
    ours, theirs = native.frame("frame-03").camera, source_of(real(shared_data, "panda002")).frame("frame-03").camera
    assert np.allclose(ours.camera_to_world, theirs.camera_to_world, atol=1e-9)
    assert np.allclose([ours.fx, ours.fy, ours.cx, ours.cy], [theirs.fx, theirs.fy, theirs.cx, theirs.cy], atol=1e-6)
    sweep = native.points("points-02")
    assert (
        17_000
        < len(sweep.points)
        < 20_000
        < len(source_of(native.root, "pandaset", mask_actors=False).points("points-02").points)
    )
    given, masked = source_of(real(shared_data, "panda002")).frame("frame-03").counts(), native.frame("frame-03").counts()
    assert (given == masked).mean() > 0.96 and 0.1 < 1 - masked.mean() < 0.2
    _, ahead = ours.project(sweep.points)
    assert 0.2 < (ahead > 0).mean() < 0.9 and np.linalg.norm(sweep.sensor - ours.position) < 3
