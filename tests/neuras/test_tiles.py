"""A scene in tiles: it draws what the whole scene draws, and a long road needs no more memory than a short one."""

from __future__ import annotations

import gzip
import io
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from bench import streaming
from pipeline.errors import UserError
from pipeline.run import run_pipeline
from stages.graphics.browser import find_browser
from stages.neuras.baking import browser
from stages.neuras.baking.site import sizes, write_site
from stages.neuras.baking.tiles import Tiling, cut
from stages.neuras.evaluation.renderers import Scene
from stages.neuras.records import AtlasMesh, CaptureInfo, FrameRecord
from tests.neuras import line, scenes

INFO = CaptureInfo("metre", 1.0, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 5.0, "none", "every other")
PLANES = (0.1, 100.0)
UP = INFO.up


def photos(cameras) -> list[FrameRecord]:
    black = io.BytesIO()
    Image.new("RGB", (8, 8)).save(black, "PNG")
    return [FrameRecord(f"frame-drive_{n:02}", camera, black.getvalue(), "train") for n, camera in enumerate(cameras)]


def needs_browser():
    if find_browser() is None:
        pytest.skip("no Chromium: install chromium")


def written(folder, baked, flat: AtlasMesh, frames, tiling: Tiling | None, expand: str = "fp16"):
    tiles = None if tiling is None else cut(flat, baked.pyramid, UP, [frame.camera for frame in frames], tiling)
    write_site(folder, baked, flat, INFO, frames, (0.1, 100.0), expand, tiles)
    return tiles


@pytest.mark.parametrize("settings, expand", [({}, "fp16"), ({"levels": 1, "quantized": False, "networks": False}, "rgba8")])
def test_the_page_draws_the_same_of_tiles_and_of_one_piece(tmp_path, settings, expand):
    needs_browser()
    flat = scenes.atlas()
    baked = scenes.baked(flat, **settings)
    frames = photos(scenes.looking_at(place, size=(90, 60)) for place in [(4.0, 3.0, 2.0), (14.0, 12.0, 5.0)])
    written(tmp_path / "whole", baked, flat, frames, None, expand)
    tiles = written(tmp_path / "tiled", baked, flat, frames, Tiling(1.5, 100.0, 8192), expand)
    assert len(tiles.tiles) >= 6
    links = ["frame=0", "frame=1", "frame=0&shift=1", "frame=0&mode=4", "frame=0&mode=5"]
    whole, tiled = (browser.pictures(tmp_path / name, links)[0] for name in ("whole", "tiled"))
    for link, one, other in zip(links, whole, tiled, strict=True):
        difference = np.abs(one.astype(int) - other).max(axis=2)
        assert (difference > 0).mean() < 0.01, link  # texture coordinates differ in the last bit
        assert (difference > 2).mean() < 0.001, link  # two samples far apart, at a silhouette
    assert not np.array_equal(whole[0], whole[1])


def road(times: int) -> tuple[Scene, list[FrameRecord]]:
    """Balls in a row, whose texels are so fine that far ones need coarse levels, and a drive beside them."""
    flat = scenes.atlas(subdivisions=1, density=48.0)
    cameras = [scenes.looking_at((x, 4.0, 1.0), (x + 4.0, 0.0, 0.0), size=(40, 28)) for x in (-2.0, 2.0)]
    return streaming.placed(Scene(scenes.baked(flat, networks=False), flat, INFO, PLANES), photos(cameras), times)


def test_a_road_five_times_as_long_needs_the_same_memory(tmp_path):
    needs_browser()
    drives, (short, long) = {}, (5, 25)
    for times in (short, long):
        scene, frames = road(times)
        streaming.write(tmp_path / str(times), scene, frames, 4.0, 7.0)
        drives[times] = streaming.drive(tmp_path / str(times), len(frames))
    most = {times: {key: max(place[key] for place in drives[times]) for key in drives[times][0]} for times in drives}
    for key in ("pool", "buffers"):
        assert most[long][key] <= 1.05 * most[short][key], key
    way = drives[long]
    assert way[0]["drawn"] and way[-1]["drawn"] and not set(way[0]["drawn"]) & set(way[-1]["drawn"])  # what is behind is gone
    assert most[long]["lacking"] == 0 and most[long]["used"] > 0.5  # the pool is no larger than it must be
    for before, after in zip(way[:-1], way[1:], strict=True):
        come = set(after["drawn"]) - set(before["drawn"])
        assert after["fine"] and not come & set(after["fine"])  # what comes far away comes without its finest level
    scene, _ = road(1)
    assert most[long]["pool"] < 0.25 * long * scene.baked.mesh_indices.size * 3 * 8  # of the road in one piece
    files = [path.stat().st_size for path in (tmp_path / str(long) / "tiles").rglob("*") if path.is_file()]
    assert way[-1]["fetches"] <= len(files) and way[-1]["fetched"] <= sum(files)  # nothing is fetched twice
    counts = [place["fetches"] for place in way]
    assert counts == sorted(counts) and counts[0] < 0.3 * counts[-1]  # as one drives, not at once
    images, _ = browser.pictures(tmp_path / str(long), [f"frame={copy}&mode=1" for copy in (3, 10, 20)])
    assert images[0].std() > 20
    for image in images[1:]:  # wherever the tiles lie in the pool
        assert (np.abs(images[0].astype(int) - image).max(axis=2) > 8).mean() < 0.01


def test_where_the_pool_is_too_small_near_tiles_are_fine_and_far_ones_coarse(tmp_path):
    needs_browser()
    scene, frames = road(5)
    streaming.write(tmp_path, scene, frames, 4.0, 100.0)
    about = json.loads((tmp_path / "scene.json").read_bytes())
    about["tiles"] |= {"columns": 1, "height": int(1.5 * max(map(sum, (tile["rows"] for tile in about["tiles"]["each"]))))}
    (tmp_path / "scene.json").write_text(json.dumps(about))
    place = streaming.drive(tmp_path, 1)[0]
    assert place["lacking"] > 0 and place["used"] <= 1 and len(place["drawn"]) == 5 and 0 < len(place["fine"]) < 5
    nearest = min(
        about["tiles"]["each"], key=lambda tile: np.linalg.norm(np.array(tile["low"]) + 2 - frames[0].camera.position)
    )
    assert about["tiles"]["each"].index(nearest) in place["fine"]


def test_a_tile_that_cannot_be_read_is_told(tmp_path):
    needs_browser()
    flat = scenes.atlas(subdivisions=1)
    baked, frames = scenes.baked(flat, networks=False), photos([scenes.looking_at((4.0, 3.0, 2.0))])
    written(tmp_path, baked, flat, frames, Tiling(1.5, 100.0, 8192))
    shutil.rmtree(tmp_path / "tiles" / "1")
    with pytest.raises(RuntimeError, match=r"tiles/1/.* cannot be read \(404\): is the folder complete"):
        browser.pictures(tmp_path, ["frame=0"])


def test_a_link_to_one_piece_has_no_tiles_and_a_site_of_tiles_no_whole_texture(tmp_path):
    flat = scenes.atlas(subdivisions=1)
    baked, frames = scenes.baked(flat), photos([scenes.looking_at((4.0, 3.0, 2.0))])
    written(tmp_path / "whole", baked, flat, frames, None)
    written(tmp_path / "tiled", baked, flat, frames, Tiling(1.5, 100.0, 8192))
    whole, tiled = ({path.name for path in (tmp_path / name).iterdir()} for name in ("whole", "tiled"))
    assert tiled - whole == {"tiles", "tiles.js"} and not whole - tiled
    assert 'src="viewer.js"' in (tmp_path / "whole" / "index.html").read_text()
    assert 'src="tiles.js"' in (tmp_path / "tiled" / "index.html").read_text()
    assert "tiles" not in json.loads((tmp_path / "whole" / "scene.json").read_bytes())
    for name in ("viewer.js", "loader.js", "style.css"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "tiled" / name).read_bytes()
    assert Image.open(tmp_path / "tiled" / "mesh_codes.png").size == (1, 1)


@pytest.mark.parametrize("levels", [1, 3])
def test_every_face_lies_in_one_tile_with_the_texels_that_it_had(tmp_path, levels):
    """Each vertex' texture coordinates, moved as the files say, find the codes that the whole texture has there."""
    flat = scenes.atlas()
    baked = scenes.baked(flat, levels=levels)
    tiles = written(tmp_path, baked, flat, photos([scenes.looking_at((4.0, 3.0, 2.0))]), Tiling(1.5, 100.0, 8192))
    assert sum(len(tile.mesh.faces) for tile in tiles.tiles) == len(flat.faces)
    corners = sorted(tuple(np.round(tile.mesh.vertices[face].ravel(), 5)) for tile in tiles.tiles for face in tile.mesh.faces)
    assert corners == sorted(tuple(np.round(flat.vertices[face].ravel(), 5)) for face in flat.faces)
    for number, tile in enumerate(tiles.tiles):
        assert np.ptp(tile.mesh.vertices[tile.mesh.faces].mean(axis=1), axis=0)[:2].max() <= 1.5 * np.sqrt(2)
        for level in range(levels):
            data = gzip.decompress((tmp_path / f"tiles/{number}/level_{level}.bin").read_bytes())
            about = np.frombuffer(data, np.int32, 8 * len(tile.charts)).reshape(-1, 8)
            image = np.frombuffer(data, np.uint16, offset=about.nbytes).reshape(tiles.rows[number][level], tiles.width)
            assert np.array_equal(about[:, 3], tile.charts)
            height, width = baked.pyramid.size(level)
            row, column = baked.pyramid.corner(level)
            places = (tile.mesh.uvs * (width, height)).astype(int)[tile.mesh.faces].reshape(-1, 2)
            there = places + np.repeat(about[tile.mesh.charts, :2], 3, axis=0)
            before = baked.mesh_indices[
                row + np.minimum(places[:, 1], height - 1), column + np.minimum(places[:, 0], width - 1)
            ]
            assert np.array_equal(image[there[:, 1], there[:, 0]], before)


def test_a_far_tile_asks_for_coarse_levels_and_a_near_one_for_all():
    flat = scenes.atlas()
    tiles = cut(flat, scenes.baked(flat).pyramid, UP, [scenes.looking_at((4.0, 3.0, 2.0))], Tiling(1.5, 100.0, 8192))
    one = replace(tiles.tiles[0], density=100.0)
    assert [one.needed(distance, 0.01) for distance in (0, 1, 1.9, 2.1, 3.9, 4.1, 900)] == [0, 0, 0, 1, 1, 2, 2]
    low = one.mesh.vertices.min(axis=0)
    assert one.distance(low) == 0 and one.distance(low - (3, 0, 4)) == pytest.approx(5)


def test_tiles_that_no_device_holds_are_refused():
    flat = scenes.atlas()
    with pytest.raises(UserError, match="lower bake.reach_m or bake.tile_m"):
        cut(flat, scenes.baked(flat).pyramid, UP, [scenes.looking_at((4.0, 3.0, 2.0))], Tiling(1.5, 100.0, 64))


def test_the_stage_cuts_where_it_is_asked_to_and_only_then(tmp_path):
    """A scene in one piece has the key that it had before there were tiles, whatever its settings say of tiles."""

    def bake(**settings):
        root = {"system": "tests.neuras.line", "stage": "bake", "store": str(tmp_path), "workers": 0}
        root |= {name: {} for name in line.SYSTEM.modules} | {"bake": settings}
        return run_pipeline(root, ["test"], lambda text: None)["artifacts"]["bake"]

    plain, tiled, finer = bake(tile_m=None), bake(tile_m=3.0), bake(tile_m=1.0, reach_m=5.0)
    assert bake().key == plain.key and len({plain.key, tiled.key, finer.key}) == 3
    assert not {"tile_m", "reach_m"} & set(plain.manifest["preimage"]["params"])
    assert not plain.file("site/index.html").with_name("tiles").exists()
    few, many = (json.loads(one.file("site/scene.json").read_bytes())["tiles"] for one in (tiled, finer))
    assert 1 < len(few["each"]) < len(many["each"]) and (few["reach"], many["reach"]) == (200.0, 5.0)
    folder = finer.file("site/index.html").parent
    assert sum(sizes(folder).values()) == sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
