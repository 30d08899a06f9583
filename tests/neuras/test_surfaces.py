"""From points to a surface, and from a surface to an atlas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from pipeline.stage import Item
from stages.graphics.arrays import unpack_arrays
from stages.graphics.cameras import Camera
from stages.graphics.casting import Caster
from stages.graphics.geometry import measure
from stages.neuras import records, s01_scaffold
from stages.neuras.rasterizing.footprints import footprint
from stages.neuras.rasterizing.texels import sheet, texels
from stages.neuras.records import CaptureInfo, FrameRecord, Mesh
from stages.neuras.s01_scaffold import ScaffoldConfig
from stages.neuras.s01_scaffold import _surfels as scaffold_surfels
from stages.neuras.s03_atlas import Atlas, AtlasConfig
from stages.neuras.surfaces import planar, reconstruct, simplify, surfels, unfold, visibility
from stages.neuras.surfaces.photometric import Photo
from tests.neuras import scenes


def sphere(subdivisions: int = 3, radius: float = 2.0) -> Mesh:
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return Mesh(np.asarray(ball.vertices, np.float32), np.asarray(ball.faces, np.int32))


def looking_at_origin(position: tuple[float, float, float], width: int = 64, height: int = 48) -> Camera:
    back = np.array(position, float)
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    pose[:3, 3] = position
    return Camera.from_fov(width, height, 60, pose)


def test_a_ray_through_a_pixel_hits_what_projects_there():
    mesh, camera = sphere(), looking_at_origin((6.0, 2.0, 3.0))
    view = Caster(mesh.vertices, mesh.faces).view(camera)
    points = view.interpolate(mesh.faces, mesh.vertices)[view.hit]
    pixels, ahead = camera.project(points)
    assert view.hit.sum() > 300
    assert np.abs(pixels - camera.pixel_centres()[view.hit]).max() < 1e-3
    assert np.allclose(np.linalg.norm(points - camera.position, axis=1), view.depth[view.hit], atol=1e-4)
    assert (ahead > 0).all()


def test_far_from_the_origin_hits_are_as_exact():
    mesh, camera = sphere(), looking_at_origin((6.0, 2.0, 3.0))
    far = np.array([500_000.0, -4_000_000.0, 100.0])
    pose = camera.camera_to_world.copy()
    pose[:3, 3] += far
    near = Caster(mesh.vertices, mesh.faces).view(camera)
    away = Caster(mesh.vertices + far, mesh.faces).view(Camera(*list(vars(camera).values())[:6], pose))
    assert (near.face == away.face).mean() > 0.99
    both = near.hit & (near.face == away.face)
    assert np.abs(near.depth - away.depth)[both].max() < 1e-3


def test_thinning_keeps_the_first_point_of_each_voxel():
    points = np.array([[0.01, 0, 0], [0.02, 0, 0], [0.5, 0, 0], [0.51, 0, 0], [0, 0, 0.9]])
    kept, ids = reconstruct.thin(points, 0.1, np.arange(5))
    assert ids.tolist() == [0, 2, 4] and np.array_equal(kept, points[[0, 2, 4]])


def test_normals_point_to_who_saw_the_point():
    points = sphere(4).vertices.astype(float)
    outward = reconstruct.normals(points, points * 3, 12)
    inward = reconstruct.normals(points, points * 0, 12)
    radial = points / np.linalg.norm(points, axis=1, keepdims=True)
    assert np.einsum("ij,ij->i", outward, radial).min() > 0.98
    assert np.einsum("ij,ij->i", inward, radial).max() < -0.98


def test_poisson_finds_the_sphere_and_trims_what_no_point_supports():
    points = sphere(4).vertices.astype(float)
    half = points[points[:, 2] > 0]
    mesh = reconstruct.poisson(half, half / np.linalg.norm(half, axis=1, keepdims=True), 6, 0.2)
    radii = np.linalg.norm(mesh.vertices, axis=1)
    assert len(mesh.faces) > 500
    assert np.median(np.abs(radii - 2)) < 0.03
    assert mesh.vertices[:, 2].min() > -0.3  # Poisson closes the lower half, far from any point


def test_a_distance_field_finds_the_sphere_across_its_blocks():
    points = sphere(5).vertices.astype(float)
    half = points[points[:, 2] > 0]
    mesh = reconstruct.distance_field(half, half / np.linalg.norm(half, axis=1, keepdims=True), 0.04, 0.15)
    welded = simplify.weld(mesh, 1e-4)
    radii = np.linalg.norm(mesh.vertices, axis=1)
    assert np.abs(radii - np.median(radii)).max() < 0.01 and abs(np.median(radii) - np.linalg.norm(half, axis=1).mean()) < 0.003
    assert mesh.vertices[:, 2].min() > -0.2 and len(welded.vertices) < len(mesh.vertices)  # more than one block
    area = 2 * np.pi * np.median(radii) ** 2
    assert measure.face_areas(welded.vertices, welded.faces).sum() == pytest.approx(area, rel=0.12)
    corners = welded.vertices[welded.faces]
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("ij,ij->i", outward, corners.mean(axis=1)) > 0).mean() > 0.99


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)])
def test_terrain_faces_up_and_drops_outliers(up):
    x, y = np.meshgrid(np.arange(20.0), np.arange(20.0))
    flat = np.stack([x.ravel(), y.ravel(), np.sin(x / 3).ravel()], axis=1)
    axes = np.linalg.svd(np.array(up)[None])[2][1:]
    points = flat[:, :1] * axes[0] + flat[:, 1:2] * axes[1] + flat[:, 2:] * np.array(up)
    points = np.concatenate([points, points[:1] + 50 * np.array(up)])
    mesh = reconstruct.terrain(points, np.array(up), 3.0, 3.0)
    assert len(mesh.vertices) == 400
    a, b, c = mesh.vertices[mesh.faces].transpose(1, 0, 2)
    assert (np.cross(b - a, c - a) @ np.array(up)).min() > 0
    bare = points[np.linalg.norm(points @ axes.T - 10, axis=1) > 4]  # no points on a round piece of ground
    open_, closed = (reconstruct.terrain(bare, np.array(up), longest, 3.0) for longest in (3.0, 20.0))
    area = [measure.face_areas(mesh.vertices @ axes.T @ axes, mesh.faces).sum() for mesh in (open_, closed)]
    assert area[0] < 0.9 * area[1] and area[1] == pytest.approx(19 * 19)


def test_welding_and_collapsing_keep_the_shape():
    soup = Mesh(*[np.ascontiguousarray(part) for part in _soup(sphere(4))])
    welded = simplify.weld(soup, 1e-4)
    assert len(welded.vertices) == len(sphere(4).vertices) and len(welded.faces) == len(soup.faces)
    small = simplify.collapse(welded, 500)
    assert 300 < len(small.faces) <= 520
    assert np.abs(np.linalg.norm(small.vertices, axis=1) - 2).max() < 0.1


def _soup(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    return mesh.vertices[mesh.faces].reshape(-1, 3), np.arange(3 * len(mesh.faces), dtype=np.int32).reshape(-1, 3)


def test_walls_of_two_faces_outlast_decimation():
    ball = sphere(5)
    corners = np.array([[0, 0, 0], [3, 0, 0], [3, 3, 0], [0, 3, 0]], np.float32)
    walls = np.concatenate([corners + (5, 5, 4 * number) for number in range(300)])
    faces = np.concatenate([np.array([[0, 1, 2], [0, 2, 3]]) + 4 * number for number in range(300)])
    mesh = Mesh(
        np.concatenate([ball.vertices, walls]).astype(np.float32),
        np.concatenate([ball.faces, faces + len(ball.vertices)]).astype(np.int32),
    )
    small = simplify.collapse(mesh, 3000, spared=25)
    beside = small.vertices[small.faces][:, :, 0].min(axis=1) > 4
    assert beside.sum() == 600 and 2000 < (~beside).sum() <= 2400
    assert len(simplify.collapse(mesh, 500, spared=25).faces) == len(mesh.faces)  # the walls alone are more


def test_specks_go_and_bodies_stay():
    ball, chip = sphere(2), Mesh(np.eye(3, dtype=np.float32) + 9, np.array([[0, 1, 2]], np.int32))
    both = Mesh(np.concatenate([ball.vertices, chip.vertices]), np.concatenate([ball.faces, chip.faces + len(ball.vertices)]))
    assert len(simplify.without_specks(both, 5).faces) == len(ball.faces)
    assert len(simplify.without_specks(both, 1).faces) == len(both.faces)
    assert len(simplify.without_specks(both, 5, 1.8).faces) == len(ball.faces)  # the diagonal of its box is 1.73
    assert len(simplify.without_specks(both, 5, 1.7).faces) == len(both.faces)


def test_culling_drops_the_far_side_and_keeps_what_cameras_beside_see():
    mesh, camera = sphere(4), looking_at_origin((8.0, 0.0, 0.0), 128, 96)
    one = visibility.seen(mesh, [camera], 2)
    beside = visibility.seen(mesh, visibility.cameras_beside([camera], (-3.0, 3.0)), 2)
    centres = mesh.vertices[mesh.faces].mean(axis=1)
    assert one[centres[:, 0] > 1.2].mean() > 0.9 and not one[centres[:, 0] < -0.2].any()
    assert (beside | ~one).all() and beside.sum() > one.sum()
    kept = visibility.kept_faces(mesh, one, 1)
    assert one.sum() < len(kept.faces) < len(mesh.faces)


def test_what_beams_went_through_is_not_there():
    wall = trimesh.creation.box((0.1, 8, 8), transform=trimesh.transformations.translation_matrix((5, 0, 0)))
    sheet = Mesh(np.array([[2, -1, -1], [2, 1, -1], [2, 0, 1]], np.float32), np.array([[0, 1, 2]], np.int32))
    n = len(wall.vertices)
    both = Mesh(
        np.concatenate([wall.vertices, sheet.vertices]).astype(np.float32),
        np.concatenate([wall.faces, sheet.faces + n]).astype(np.int32),
    )
    y, z = (grid.ravel() for grid in np.meshgrid(np.linspace(-2, 2, 20), np.linspace(-2, 2, 20)))
    ends = np.stack([np.full_like(y, 4.95), y, z], axis=1)
    left = visibility.carved(both, ends, np.zeros_like(ends), 0.3)
    assert len(left.faces) == len(both.faces) - 1 and left.vertices[:, 0].min() > 4
    stopped = np.where((np.arange(len(ends)) % 5 < 3)[:, None], ends * 2 / 4.95, ends)  # most beams end at the sheet
    assert len(visibility.carved(both, stopped, np.zeros_like(ends), 0.3).faces) == len(both.faces)


def test_a_surfel_is_a_square_about_its_point_and_faces_its_viewer():
    rng = np.random.default_rng(3)
    points, viewers = rng.normal(size=(20, 3)), rng.normal(size=(20, 3)) * 5
    viewers[:3] = points[:3] + 4 * np.eye(3)  # along the axes too
    squares = surfels.at_points(points, viewers, 0.2)
    corners = squares.vertices.reshape(20, 4, 3)
    assert np.allclose(corners.mean(axis=1), points, atol=1e-5)
    assert np.allclose(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2), 0.2, atol=1e-5)
    assert np.allclose(measure.face_areas(squares.vertices, squares.faces), 0.02, rtol=1e-4)
    towards = (viewers - points) / np.linalg.norm(viewers - points, axis=1, keepdims=True)
    normals = measure.face_vectors(squares.vertices.astype(float), squares.faces)
    cosines = np.einsum("ij,ij->i", normals, np.repeat(towards, 2, axis=0)) / np.linalg.norm(normals, axis=1)
    assert np.allclose(cosines, 1, atol=1e-4)
    assert not len(surfels.at_points(points[:0], viewers[:0], 0.2).faces)


@pytest.mark.parametrize("source", ["auto", "distance_field"])
def test_a_surface_reaches_as_far_as_sparse_points_are_apart(monkeypatch, source):
    """Tracks of photos are as far apart as detail is, and a nominal metre says nothing of that."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-5, 5, (2000, 2)), np.zeros(2000)])
    ahead = replace(scenes.looking_at((0.0, -8.0, 2.0)))  # no flight
    monkeypatch.setattr(s01_scaffold, "_points", lambda capture, views: (points, points + [0.0, 0.0, 9.0]))
    monkeypatch.setattr(records, "given_mesh", lambda capture: None)
    info = CaptureInfo("arbitrary", 0.1, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 10.0, "sfm", "every other")
    views = [FrameRecord("frame-0", ahead, b"", "train")]
    mesh, stated, _ = s01_scaffold._surface(ScaffoldConfig(depth=8, source=source), None, info, views)
    area = np.linalg.norm(measure.face_vectors(mesh.vertices.astype(float), mesh.faces), axis=1).sum() / 2
    assert stated["source"] == {"auto": "poisson"}.get(source, source) and area == pytest.approx(100, rel=0.15)


def test_points_that_the_surface_passes_by_become_surfels():
    """A wire over a ground. Where somebody stood once, and all other beams went through, nothing is left."""
    corners = np.array([[-5, -5, 0], [5, -5, 0], [5, 5, 0], [-5, 5, 0]], np.float32)
    ground = Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32))
    rng = np.random.default_rng(0)
    on_ground = np.column_stack([rng.uniform(-4, 4, (300, 2)), rng.normal(0, 0.02, 300)])
    wire = np.column_stack([np.linspace(-4, 4, 50), np.zeros(50), np.full(50, 3.0)])
    places = np.concatenate([on_ground, wire])
    sensors = places + [0.0, -9.0, 0.0]
    sensors[:300] = [0.0, -9.0, 4.0]
    passer_by, sensor = np.array([1.0, -3.0, 1.5]), np.array([1.0, -3.0, 5.0])
    below = np.repeat([[1.0, -3.0, 0.0]], 30, axis=0)  # of other turns
    points = np.concatenate([places, [passer_by], below])
    seen_from = np.concatenate([sensors, [sensor], np.repeat([sensor], 30, axis=0)])
    info = CaptureInfo("metre", 2.0, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 5.0, "lidar", "every other")

    def centres(**settings) -> np.ndarray:
        found = scaffold_surfels(ScaffoldConfig(voxel_m=0.08, **settings), info, ground, points, seen_from)
        return found.vertices.reshape(-1, 4, 3).mean(axis=1)

    assert np.allclose(centres(), wire, atol=1e-5)
    assert np.allclose(centres(carve=False), np.concatenate([wire, [passer_by]]), atol=1e-5)
    assert not len(centres(surfels=0))
    at_sensor = scaffold_surfels(ScaffoldConfig(), info, ground, np.array([[0.0, 0.0, 2.0]]), np.array([[0.0, 0.0, 2.0]]))
    assert not len(at_sensor.faces)


def test_of_too_many_surfels_the_nearest_stay():
    points = np.column_stack([np.arange(10.0), np.zeros(10), np.zeros(10)])
    squares = surfels.at_points(points, points + [0, 0, 1.0], 0.1)
    few = surfels.nearest(squares, [np.array([0.0, 0, 0]), np.array([9.0, 0, 0])], 4)
    assert np.allclose(few.vertices.reshape(-1, 4, 3).mean(axis=1)[:, 0], [0, 1, 8, 9], atol=1e-6)
    assert surfels.nearest(squares, [np.zeros(3)], 10) is squares


def test_surfels_that_photos_see_through_are_found():
    """Before a wall one that is there and one that is not, before the sky one that is not, and one that no photo shows."""
    rng = np.random.default_rng(4)
    pattern, sky = rng.random((64, 64, 3)), rng.random((64, 64, 3))
    wall = Mesh(
        np.array([[-8, 8, -8], [8, 8, -8], [8, 8, 2], [-8, 8, 2]], np.float32), np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    )
    places = np.array([[-1.0, 3, 0], [1.0, 3, 0], [0.0, 3, 1.5], [0.0, -5, 0]])
    squares = surfels.at_points(places, places - [0, 9.0, 0], 0.5)
    mesh, there = Mesh.joined(wall, squares), Mesh.joined(wall, Mesh.compact(squares.vertices, squares.faces[:2]))
    photos, on_second = [], []
    for x in np.linspace(-1, 1, 6):
        pose = np.eye(4)
        pose[:3, :3] = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # looks along +y, z up
        pose[:3, 3] = [x, 0, 0]
        camera = Camera(80, 80, 60.0, 60.0, 40.0, 40.0, pose)
        view, directions = Caster(there.vertices, there.faces).view(camera), camera.directions()
        points = camera.position + directions * view.depth[..., None]

        def look(texture: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
            return texture[(v * 64).astype(int).clip(0, 63), (u * 64).astype(int).clip(0, 63)]

        on_wall = look(pattern, (points[..., 0] + 8) / 16, (points[..., 2] + 8) / 16)
        colours = np.where(view.hit[..., None], on_wall, look(sky, directions[..., 0] + 0.5, directions[..., 2]))
        colours[view.face >= 2] = [0.9, 0.1, 0.1]
        photos.append(Photo(camera, (colours * 255).astype(np.uint8), np.ones((80, 80), bool)))
        on_second.append(np.isin(Caster(mesh.vertices, mesh.faces).view(camera).face, (4, 5)))

    def found(photos: list[Photo]) -> list[bool]:
        return surfels.seen_through(mesh, len(squares.faces), photos, 4).tolist()

    assert found(photos) == [False, True, True, False]
    masked = [replace(photo, counts=~hidden) for photo, hidden in zip(photos, on_second, strict=True)]
    assert found(masked) == [False, False, True, False]
    assert not any(found(photos[:1]))  # nothing tells


def test_pixels_per_unit_grow_as_the_camera_comes_nearer():
    mesh = sphere(3)
    near, far = (visibility.pixels_per_unit(mesh, [looking_at_origin((d, 0.0, 0.0))]).max() for d in (4.0, 8.0))
    assert near == pytest.approx(far * 3, rel=0.02)  # the surface lies 2 nearer than the centre


@pytest.fixture(scope="module", params=["xatlas", "planar"])
def atlas(request):
    by, packer = {"xatlas": (unfold, unfold.by_xatlas), "planar": (planar, planar.pack)}[request.param]
    mesh = sphere(3)
    rows = unfold.tiles(mesh, 400)
    assert len(rows) == 4 and np.array_equal(np.sort(np.concatenate(rows)), np.arange(len(mesh.faces)))
    return mesh, unfold.pack([by.unfold(mesh, r, 20.0, 2) for r in rows], 2, packer=packer)


def test_an_atlas_is_the_same_surface(atlas):
    mesh, flat = atlas
    assert np.allclose(flat.vertices[flat.faces], mesh.vertices[mesh.faces], atol=1e-6)
    assert flat.width % 4 == 0 and flat.height % 4 == 0
    assert flat.uvs.min() >= 0 and flat.uvs.max() <= 1
    a, b, c = (flat.uvs[flat.faces[:, i]].astype(float) * (flat.width, flat.height) for i in range(3))
    areas = np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2
    surface = (
        np.linalg.norm(np.cross(*(mesh.vertices[mesh.faces[:, i]] - mesh.vertices[mesh.faces[:, 0]] for i in (1, 2))), axis=1)
        / 2
    )
    assert np.median(np.sqrt(areas / surface)) == pytest.approx(20.0, rel=0.12)
    assert np.sqrt(areas / surface).min() > 20 / 1.75


def test_no_bilinear_footprint_leaves_its_chart(atlas):
    _, flat = atlas
    drawn = texels(flat)
    chart = np.where(drawn.face >= 0, flat.charts[drawn.face], -1)
    chart = drawn.dilated(chart, 3)
    rng = np.random.default_rng(0)
    weights = rng.dirichlet([1, 1, 1], size=(len(flat.faces), 8))
    points = np.einsum("fsk,fkd->fsd", weights, flat.uvs[flat.faces].astype(float)) * (flat.width, flat.height)
    corner = np.floor(points - 0.5).astype(int)
    for dx in (0, 1):
        for dy in (0, 1):
            found = chart[np.clip(corner[..., 1] + dy, 0, flat.height - 1), np.clip(corner[..., 0] + dx, 0, flat.width - 1)]
            assert (found == flat.charts[:, None]).mean() > 0.999


def test_a_fixed_size_is_kept_and_holds_all(atlas):
    mesh, _ = atlas
    parts = [unfold.unfold(mesh, rows, 60.0, 2) for rows in unfold.tiles(mesh, 400)]
    flat = unfold.pack(parts, 2, size=256)
    assert (flat.width, flat.height) == (256, 256) and flat.uvs.max() <= 1


def test_a_sliver_costs_itself_and_not_its_tile():
    ball = sphere()
    line = np.array([[0, 0, 3], [1, 0, 3], [2, 0, 3]], np.float32)
    last = len(ball.vertices)
    mesh = Mesh(
        np.concatenate([ball.vertices, line]), np.concatenate([[[last, last + 1, last + 2]], ball.faces]).astype(np.int32)
    )
    rows = np.arange(len(mesh.faces))
    assert (unfold.unfold(mesh, rows, 20.0, 2).charts < 0).sum() == 1
    (record,) = Atlas().process((AtlasConfig(), mesh, [rows], [20.0]), Item("tile_0000"))
    tile = unpack_arrays(record.members["tile.npz"])
    assert (tile["charts"] >= 0).all() and tile["source"].tolist() == rows[1:].tolist()


def test_what_covers_itself_gets_charts_of_its_own():
    """A stair's spiral: all faces look up, and its second turn lies above the first."""
    turns, steps = 2.5, 60
    angle = np.linspace(0, 2 * np.pi * turns, steps)
    rim = np.stack([np.cos(angle), np.sin(angle), 0.1 * angle], axis=1)
    vertices = np.concatenate([0.4 * rim * (1, 1, 2.5), rim]).astype(np.float32)
    a = np.arange(steps - 1)
    around = [np.stack([a, a + steps, a + steps + 1], 1), np.stack([a, a + steps + 1, a + 1], 1)]
    faces = np.concatenate(around).astype(np.int32)
    mesh = Mesh(vertices, faces)
    flat = unfold.pack([planar.unfold(mesh, np.arange(len(faces)), 40.0, 2)], 2, packer=planar.pack)
    assert flat.charts.max() >= 2
    drawn = texels(flat)
    centre = np.einsum("fkd->fd", flat.uvs[flat.faces].astype(float)) / 3 * (flat.width, flat.height)
    column, row = np.floor(centre).astype(int).T
    assert (flat.charts[drawn.face[row, column]] == flat.charts).all()
    spot, _, _ = Caster(np.c_[flat.uvs, np.zeros(len(flat.uvs))], flat.faces).cast(
        np.c_[centre / (flat.width, flat.height), np.ones(len(centre))], np.broadcast_to([0.0, 0.0, -1.0], (len(centre), 3))
    )
    assert (spot == np.arange(len(faces))).all()


def test_tiles_do_not_overlap_in_the_texture(atlas):
    _, flat = atlas
    drawn = texels(flat)
    assert 0.4 < (drawn.face >= 0).mean() < 1
    centre = np.einsum("fkd->fd", flat.uvs[flat.faces].astype(float)) / 3 * (flat.width, flat.height)
    column, row = np.floor(centre).astype(int).T
    same = drawn.face[row, column] == np.arange(len(flat.faces))
    neighbours = flat.charts[drawn.face[row, column]] == flat.charts
    assert (same | neighbours).all()


def test_footprints_are_what_neighbouring_rays_cut_out():
    """Against the definition: texture coordinates a bit to each side of a pixel's centre, on the plane of the face."""
    atlas, camera = scenes.atlas(), scenes.looking_at((4.0, 3.0, 2.0))
    view = Caster(atlas.vertices, atlas.faces).view(camera)
    ours = footprint(view, camera, atlas)
    centres, size = camera.pixel_centres(), np.array([atlas.width, atlas.height])
    corners, oblong = atlas.vertices[atlas.faces].astype(float), []
    for row, column in np.argwhere(view.hit)[::37]:
        a, b, c = corners[view.face[row, column]]
        flat = atlas.uvs[atlas.faces[view.face[row, column]]] * size

        def place(offset, a=a, b=b, c=c, flat=flat, row=row, column=column):
            ray = camera.directions(centres[row, column] + offset)
            s, t, _ = np.linalg.solve(np.stack([b - a, c - a, -ray], axis=1), camera.position - a)
            return flat[0] + s * (flat[1] - flat[0]) + t * (flat[2] - flat[0])

        across = (place((1e-3, 0)) - place((-1e-3, 0))) / 2e-3
        down = (place((0, 1e-3)) - place((0, -1e-3))) / 2e-3
        longer = max(across, down, key=np.linalg.norm)
        length = np.linalg.norm(longer)
        width = abs(across[0] * down[1] - across[1] * down[0]) / length
        assert ours.detail[row, column] == pytest.approx(np.log2(max(length / 2, width)), abs=1e-3)
        expected = 0.25 * (1 - width / length) * longer
        assert np.allclose(ours.spread[row, column] * size, expected, atol=1e-3 * length)
        oblong.append(length / width)
    assert max(oblong) > 3 and min(oblong) < 1.5
    assert (ours.detail[~view.hit] == 0).all() and (ours.spread[~view.hit] == 0).all()


def test_a_coarse_texel_lies_amid_the_finer_ones():
    from model.neuras.sampling import Pyramid

    atlas = scenes.atlas()
    pyramid = Pyramid(atlas.width, atlas.height, 3)
    positions, inside = sheet(atlas, pyramid, 1.5)
    assert positions.shape == (*pyramid.sheet, 3) and inside.shape == pyramid.sheet
    fine = texels(atlas)
    for level in (1, 2):
        (row, column), (height, width) = pyramid.corner(level), pyramid.size(level)
        place = np.s_[row : row + height, column : column + width]
        whole = (fine.face >= 0).reshape(height, 1 << level, width, 1 << level).all(axis=(1, 3))
        assert whole.sum() > 20 and inside[place][whole].all() and not inside[place].all()
        means = positions[: atlas.height, : atlas.width].reshape(height, 1 << level, width, 1 << level, 3).mean(axis=(1, 3))
        assert np.abs(positions[place] - means)[whole].max() < 1e-5
