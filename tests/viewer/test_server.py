"""What the viewer's server answers, and what it refuses, without a browser."""

from __future__ import annotations

import http.client
import json
import signal
import socket
import subprocess
import sys
import urllib.request
from types import SimpleNamespace
from urllib.parse import quote

import numpy as np
import pytest

from pipeline.errors import UserError
from pipeline.store import Store
from stages import systems
from stages.cli import main
from stages.graphics.exr import decode_lights
from stages.graphics.panels import Context, Facts, Lazy, general, pack, resolve, unpack
from stages.renderformer.records import SceneRecord
from stages.renderformer.viewing import models, scenes
from stages.viewer.command import viewer_of
from stages.viewer.server import Server, Viewer
from tests.conftest import ROOT
from tests.viewer import stores


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    root = tmp_path_factory.mktemp("viewer") / "store"
    return root, stores.renderformer(root), stores.neuras(root)


@pytest.fixture(scope="module")
def server(store):
    with Server(viewer_of(str(store[0]), systems=list(systems()))) as server:
        server.serve_in_background()
        yield server
        server.shutdown()


def ask(server, path: str, method: str = "GET", body: bytes | None = None, **headers: str):
    """(status, headers, body)."""
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=30)
    headers = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request(method, path, body, {"Host": f"127.0.0.1:{server.server_port}", **headers})
    answer = connection.getresponse()
    data = answer.read()
    connection.close()
    return answer.status, answer.headers, data


def panels(server, artifact, record: str = "") -> list:
    status, _, data = ask(server, f"/api/panels?artifact={artifact.name}&record={record}")
    assert status == 200, data
    return unpack(data)


def lazies(value) -> list[str]:
    """Paths of all that a page would load later."""
    if isinstance(value, dict):
        return [value["lazy"]] if "lazy" in value else [path for v in value.values() for path in lazies(v)]
    return [path for v in value for path in lazies(v)] if isinstance(value, list) else []


# -- what is shown


def test_every_artifact_and_record_of_both_systems_has_panels(server, store):
    root, rf, neuras = store
    kinds = {}
    for artifact in [*rf.values(), *neuras.values()]:
        for record in ["", *artifact.ids()]:
            shown = panels(server, artifact, record)
            assert shown or not record, f"{artifact.name} {record}"
            kinds.setdefault(artifact.name.rpartition("/")[0], set()).update(panel.get("kind", "lazy") for panel in shown)
            for path in lazies(shown):
                status, _, data = ask(server, f"/api/lazy?artifact={artifact.name}&record={record}&path={quote(path)}")
                assert status == 200, data
    assert all("space" in kinds[stage] for stage in ("collect", "remesh", "decimate", "scene", "render", "shard"))
    assert all("space" in kinds[f"neuras/{stage}"] for stage in ("capture", "scaffold", "refine", "atlas", "evaluate"))
    assert {"curves", "pictures"} <= kinds["train"] and {"curves", "pictures"} <= kinds["neuras/fit"]
    assert {"images", "page"} <= kinds["evaluate"] and "page" in kinds["neuras/bake"] and "images" in kinds["probe"]


def test_the_store_is_told_with_counts_rejects_digests_and_lineage(server, store):
    root, rf, neuras = store
    overview = json.loads(ask(server, "/api/store")[2])
    found = {artifact["name"]: artifact for artifact in overview["artifacts"]}
    assert len(found) == len(rf) + len(neuras) and overview["damaged"] == []
    decimate = found[rf["decimate"].name]
    assert decimate["rejects"] == {"no_rung": 1} and decimate["records"] == 1
    assert decimate["digest"] == rf["decimate"].digest and decimate["inputs"] == {"remesh": rf["remesh"].key}
    reject = json.loads(ask(server, f"/api/reject?artifact={rf['decimate'].name}&item=ball-1")[2])
    assert reject["reason"] == "no_rung" and reject["meaning"].startswith("no budget")
    assert [entry["stage"] for entry in reject["inputs"]] == ["remesh", "collect"]  # the source mesh, to be shown beside
    about = json.loads(ask(server, f"/api/record?artifact={rf['shard'].name}&record=test-000001")[2])
    assert about["previous"] == "test-000000" and {entry["stage"] for entry in about["inputs"]} == {"scene", "render"}


def test_images_come_as_they_are_stored(server, store):
    _, rf, _ = store
    artifact = rf["render"]
    (space, *_) = panels(server, artifact, "test-000000")
    path = space["panes"][0]["eyes"][0]["image"]["lazy"]
    image = unpack(ask(server, f"/api/lazy?artifact={artifact.name}&record=test-000000&path={quote(path)}")[2])
    lights, _ = decode_lights(artifact.read("test-000000").members["view0.exr"], dtype=None)
    assert image["lights"].dtype == np.float16 and np.array_equal(image["lights"], lights)
    assert set(image["layers"]) == {"direct", "albedo", "normal", "depth", "coverage", "triangle", "object"}


def test_a_long_list_comes_in_pages(server, store, monkeypatch):
    _, rf, _ = store
    monkeypatch.setattr("stages.viewer.pages.PAGE_SIZE", 2)
    name = rf["scene"].name
    page = json.loads(ask(server, f"/api/records?artifact={name}&start=2")[2])
    assert page["total"] == 3 and [row["id"] for row in page["records"]] == rf["scene"].ids()[2:]
    assert json.loads(ask(server, f"/api/records?artifact={name}&find=000001")[2])["total"] == 1


def test_a_file_is_sent_in_ranges_and_an_artifacts_page_gets_no_origin(server, store):
    name = f"/files/{server.viewer.word}/{store[1]['evaluate'].name}/report.html"
    status, headers, data = ask(server, name, Range="bytes=2-6")
    assert status == 206 and data == b"docty" and headers["Content-Range"].startswith("bytes 2-6/")
    assert "sandbox allow-scripts" in headers["Content-Security-Policy"]
    assert "allow-same-origin" not in headers["Content-Security-Policy"]
    assert ask(server, name, Sec_Fetch_Site="cross-site", Sec_Fetch_Mode="cors", Sec_Fetch_Dest="empty")[0] == 200
    assert ask(server, name.replace(server.viewer.word, "guess"))[0] == 404


# -- what is refused


@pytest.mark.parametrize(
    "path",
    [
        "/../../etc/passwd",
        "/%2e%2e/server.py",
        "/page/../server.py",
        "/files/{word}/{shard}/../manifest.json",
        "/files/{word}/{shard}/..%2fmanifest.json",
        "/files/{word}/{shard}/%2e%2e/%2e%2e/%2e%2e/secret",
        "/files/{word}/{shard}//etc/passwd",
        "/files/{word}/../{shard}/card.html",
        "/member/{shard}/../../../secret/x",
        "/member/{shard}/test-000000/../../manifest.json",
        "/api/panels?artifact=../{shard}",
        "/api/panels?artifact=/etc/x-0123456789ab",
        "/api/curves?artifact={shard}&file=../manifest.json",
        "/api/lazy?artifact={shard}&record=test-000000&path=/0/__class__",
    ],
)
def test_no_path_leads_out(server, store, path):
    root, rf, _ = store
    (root / "secret").write_text("treasure")
    status, _, data = ask(server, path.format(shard=rf["shard"].name, word=server.viewer.word))
    assert status in (400, 404) and b"treasure" not in data and b"root:" not in data
    assert json.loads(data)["error"]


def test_a_link_in_an_artifact_that_leads_out_is_not_followed(tmp_path):
    made = stores.commit(tmp_path / "store", "probe", files={"table.md": b"a"})
    (tmp_path / "secret").write_text("secret")
    (made.path / "files" / "table.md").unlink()
    (made.path / "files" / "table.md").symlink_to(tmp_path / "secret")
    with pytest.raises(UserError, match="leads out"):
        viewer_of(str(tmp_path / "store"), systems=list(systems())).pages.file(made.name, "table.md")


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:{port}", "127.0.0.1", "127.0.0.1:1", "", "127.0.0.1:{port}.evil"]
)
def test_a_name_that_was_made_to_point_here_is_refused(server, host):
    status, _, data = ask(server, "/api/store", Host=host.format(port=server.server_port))
    assert status == 421 and b"artifacts" not in data


@pytest.mark.parametrize("host", ["localhost:{port}", "127.0.0.1:{port}", "[::1]:{port}"])
def test_this_machines_own_names_are_answered(server, host):
    assert ask(server, "/api/start", Host=host.format(port=server.server_port))[0] == 200


def test_other_sites_are_refused(server, store):
    cross = {"Sec_Fetch_Site": "cross-site", "Sec_Fetch_Mode": "no-cors", "Sec_Fetch_Dest": "script"}
    assert ask(server, "/api/store", **cross)[0] == 403
    assert (
        ask(server, "/api/store", Sec_Fetch_Site="same-site", Sec_Fetch_Mode="cors")[0] == 403
    )  # another port of this machine
    assert ask(server, "/", Sec_Fetch_Site="cross-site", Sec_Fetch_Mode="navigate")[0] == 200  # a link, or a notebook's frame
    path, body = "/api/act/renderformer/checkpoints", b"{}"
    kind = {"Content_Type": "application/json"}
    assert ask(server, path, "POST", body, **kind)[0] == 200
    assert ask(server, path, "POST", body, Origin=f"http://127.0.0.1:{server.server_port}", **kind)[0] == 200
    assert ask(server, path, "POST", body, Origin="http://evil.example", **kind)[0] == 403
    assert ask(server, path, "POST", body, Content_Type="text/plain")[0] == 415  # what a form of another site could send
    assert ask(server, path, "POST", Content_Length=str((1 << 20) + 1), **kind)[0] == 413  # before it is sent
    policy = ask(server, "/")[1]["Content-Security-Policy"]
    assert "default-src 'none'" in policy and "http:" not in policy.partition("frame-ancestors")[0]  # nothing from elsewhere


def test_an_action_takes_no_folder_of_a_strangers_choice(server, store):
    body = json.dumps({"checkpoint": "/tmp", "scene": {"artifact": store[1]["shard"].name, "record": "test-000000"}}).encode()
    status, _, data = ask(server, "/api/act/renderformer/predict", "POST", body, Content_Type="application/json")
    assert status == 400 and "no checkpoint of this viewer" in json.loads(data)["error"]


# -- bad input


def test_what_does_not_exist_is_told(server, store):
    name = store[1]["shard"].name
    for path, words in (
        (f"/api/panels?artifact={name}&record=nobody", "there is no record 'nobody'"),
        ("/api/artifact?artifact=shard/none-0123456789ab", "there is no artifact"),
        (f"/files/{server.viewer.word}/{name}/none.html", "has no file"),
        ("/api/none", "there is no /api/none"),
        ("/none.js", "there is no page"),
    ):
        status, _, data = ask(server, path)
        assert status in (400, 404) and words in json.loads(data)["error"]


def test_a_damaged_part_and_a_damaged_manifest_are_told(tmp_path):
    made = stores.commit(tmp_path / "store", "probe", [stores.Record("one", {"metrics.json": b"{}"})])
    viewer = viewer_of(str(tmp_path / "store"), systems=list(systems()))
    with Server(viewer) as server:
        server.serve_in_background()
        (part,) = (made.path / "parts").iterdir()
        sound = part.read_bytes()
        part.write_bytes(sound.replace(b"{}", b"[]"))  # as many bytes, but others
        status, _, data = ask(server, f"/api/record?artifact={made.name}&record=one")
        assert status == 409 and "is changed at record one; `lightmill repair" in json.loads(data)["error"]
        part.write_bytes(b"cut")
        status, _, data = ask(server, f"/api/panels?artifact={made.name}&record=one")
        assert status in (400, 409) and "repair" in json.loads(data)["error"] or "cut off" in json.loads(data)["error"]
        (made.path / "manifest.json").write_text("{")
        assert json.loads(ask(server, "/api/store")[2])["damaged"] == [made.name]
        status, _, data = ask(server, f"/api/artifact?artifact={made.name}")
        assert status == 409 and "repair" in json.loads(data)["error"]
        server.shutdown()


def test_a_store_that_is_being_written_shows_its_progress(tmp_path):
    store = Store(tmp_path / "store")
    draft = store.draft("render", "ab" * 32, {"stage": "render", "version": 1, "params": {}, "inputs": {}})
    (draft.path / "running").mkdir(exist_ok=True)
    facts = {"total": 20, "done": 5, "reused": 0, "seconds": 2.5, "rejects": {"dark": 2}, "parts": 5}
    (draft.path / "running" / "run.json").write_text(json.dumps(facts))
    claim = store.claim("render", "ab" * 32)
    assert claim.take()
    try:
        overview = viewer_of(str(tmp_path / "store"), systems=list(systems())).answer("store", {})
    finally:
        claim.release()
    (state,) = overview["states"]
    assert overview["artifacts"] == [] and state["place"] == "render" and state["rejects"] == {"dark": 2}
    assert (state["done"], state["total"]) == (5, 20)


def test_a_port_in_use_is_told_in_a_line(store, capsys):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert main(["view", str(store[0]), "--port", str(port), "--no-browser"]) == UserError.status
    assert f"127.0.0.1 port {port} cannot be used" in capsys.readouterr().err


def test_ctrl_c_stops_it(store):
    words = [sys.executable, "-m", "stages.cli", "view", str(store[0]), "--port", "0", "--no-browser"]
    process = subprocess.Popen(
        words, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),  # a shell's background job ignores it
    )  # fmt: skip
    try:
        address = process.stdout.readline().split()[0]
        with urllib.request.urlopen(f"{address}api/start") as answer:
            assert json.loads(answer.read())["store"]
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
        assert (process.returncode, out, err) == (0, "stopped\n", "")
    finally:
        process.kill()


@pytest.mark.parametrize(
    ("what", "words"),
    [("nowhere", "no artifact 'nowhere'"), ("shard/nobody", "there is no record 'nobody'"), ("README.md", "nothing to view")],
)
def test_what_cannot_be_viewed_is_told_in_a_line(store, capsys, what, words):
    assert main(["view", what, "--store", str(store[0]), "--no-browser"]) == UserError.status
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line


def test_what_names_an_artifact_a_record_or_a_file(store, tmp_path):
    root, rf, _ = store
    start = lambda what: viewer_of(what, str(root), systems=list(systems())).start  # noqa: E731
    assert start("shard") == f"#/artifact/{rf['shard'].name}"
    assert start("shard/test-000000") == f"#/record/{rf['shard'].name}/test-000000"
    assert start(f"{rf['shard'].name}/test-000000") == f"#/record/{rf['shard'].name}/test-000000"
    (tmp_path / "ball.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert start(str(tmp_path / "ball.obj")) == "#/file"
    assert viewer_of(str(rf["shard"].path), str(tmp_path / "none"), systems=list(systems())).context.store.root == root


def test_a_notebook_gets_a_frame_of_its_own_server(store):
    import lightmill

    frame = lightmill.view("shard", store=store[0], height=500)
    try:
        page = frame._repr_html_()
        assert f'src="{frame.address}"' in page and "500px" in page and frame.address.startswith("http://127.0.0.1:")
        address = frame.address.partition("#")[0]
        with urllib.request.urlopen(address) as answer:  # as a notebook's frame
            assert "frame-ancestors 'self' http://localhost:*" in answer.headers["Content-Security-Policy"]
        assert frame.address.endswith(store[1]["shard"].name)
    finally:
        frame.close()
    with pytest.raises(UserError):
        lightmill.view("nowhere", store=store[0])


# -- values as bytes, and edits


def test_arrays_are_packed_as_they_are():
    value = {"a": np.arange(6, dtype=np.float16).reshape(2, 3), "b": [np.zeros((0, 3), np.int32), {"c": float("nan")}]}
    back = unpack(pack([Facts("title", value), Lazy(lambda: 1)]))
    assert back[0]["kind"] == "facts" and np.array_equal(back[0]["values"]["a"], value["a"])
    assert back[0]["values"]["a"].dtype == np.float16 and back[0]["values"]["b"][0].shape == (0, 3)
    assert back[0]["values"]["b"][1] == {"c": None} and back[1] == {"lazy": "/1"}
    with pytest.raises(TypeError):
        pack(np.array(["text"]))


def test_a_lazy_is_found_by_its_path_and_nothing_else_is():
    value = [{"deep": [Lazy(lambda: 7)]}]
    assert resolve(value, unpack(pack(value))[0]["deep"][0]["lazy"]) == 7
    for path in ("/0", "/0/deep", "/0/deep/1", "/0/deep/-1", "/x", ""):
        with pytest.raises(UserError):
            resolve(value, path)


def test_curves_are_read_from_both_kinds_of_log_and_a_line_that_is_being_written_is_left_out():
    assert general.curves('{"step": 1, "loss": 2.0}\n{"step": 2, "lo') == {"loss": [(1, 2.0)]}
    assert general.curves("step,loss,psnr\n1,2,\n2,1,20\n", "curve.csv") == {"loss": [(1, 2), (2, 1)], "psnr": [(2, 20)]}
    assert general.curves("free text") == {}


def test_edits_change_what_they_name_and_nothing_else(store):
    artifact = store[1]["scene"]
    scene = SceneRecord.from_record(artifact.read("test-000000"))
    turn = [[0, -1, 0, 0.1], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    edits = {"objects": {"0": turn}, "materials": {"1": {"diffuse": [1, 0, 0]}}, "lights": {"0": [2, 0, 1]}}
    edited = models.edited(scene, edits)
    first, second, light = scene.object_index == 0, scene.object_index == 1, scene.light_index == 0
    x, y, z = np.moveaxis(scene.triangles[first], -1, 0)
    assert np.allclose(edited.triangles[first], np.stack([0.1 - y, x, z], axis=-1), atol=1e-6)
    assert np.array_equal(edited.triangles[~first], scene.triangles[~first])
    assert (edited.diffuse[second] == [1, 0, 0]).all() and np.array_equal(edited.diffuse[~second], scene.diffuse[~second])
    assert np.allclose(edited.emission[light], scene.emission[light] * [2, 0, 1])
    scaled = [[2, 0, 0, 0], *turn[1:]]
    for bad in ({"objects": {"0": scaled}}, {"objects": {"x": turn}}, {"lights": {"0": [1, None, 1]}}, {"materials": {"0": 1}}):
        with pytest.raises(UserError):
            models.edited(scene, bad)


@pytest.mark.filterwarnings("ignore::stages.renderformer.inference.renderer.LimitWarning")
def test_pictures_that_are_not_square_are_predicted_and_have_attention(store):
    root, rf, _ = store
    context = Context(Store(root))
    scene = SceneRecord.from_record(rf["scene"].read("test-000000"))
    camera = {"camera_to_world": scene.camera_to_world[0].tolist(), "fov_deg": 40.0, "aspect": 1.6}
    shipped = "ships:renderformer"
    request = {"scene": {"artifact": rf["scene"].name, "record": "test-000000"}, "checkpoint": shipped, "camera": camera}
    answer = models.predict(context, {**request, "resolution": 64})
    assert answer["image"].lights.shape == (1, 40, 64, 3)
    weights = models.attention(context, {**request, "resolution": 64, "pixel": [0.99, 0.99]})["weights"]
    assert weights.shape[1] == len(scene.triangles) and (weights.sum(axis=1) <= 1.001).all() and weights.any()
    blind = SimpleNamespace(gathering_layers=list)  # a network whose pixels look at no triangles
    context.kept["renderers"][shipped] = SimpleNamespace(model=blind)
    with pytest.raises(UserError, match="no attention"):
        models.attention(context, {**request, "resolution": 64, "pixel": [0.5, 0.5]})
    del context.kept["renderers"][shipped]
    with pytest.raises(UserError, match="aspect"):
        models.predict(context, {**request, "camera": {**camera, "aspect": 0}})
    scene.meta["aspect"] = [1.6] * len(scene.fov_deg)
    camera = scenes.camera_of(scene, 0)
    assert (camera.width, camera.height) == (512, 320) and camera.fy == pytest.approx(
        160 / np.tan(np.radians(scene.fov_deg[0]) / 2)
    )


def test_a_system_without_views_is_shown_by_its_members_names(tmp_path):
    record = stores.Record("one", {"txt": b"words", "picture.png": stores.png(0), "metrics.json": b'{"a": 1}'})
    made = stores.commit(tmp_path / "store", "strange/thing", [record])
    viewer = Viewer(Context(Store(tmp_path / "store")), list(systems()))
    assert [system["name"] for system in viewer.answer("store", {})["systems"]] == ["renderformer", "neuras", "strange"]
    shown = viewer.answer("panels", {"artifact": made.name, "record": "one"})
    assert {panel["kind"] for panel in unpack(shown)} == {"pictures", "words", "facts"}
