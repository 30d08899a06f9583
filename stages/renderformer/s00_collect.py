"""Stage collect: meshes from a folder, from Objaverse or from made-up families, normalised, without duplicates, split.

Reads source files; writes one MeshRecord per mesh and ``files/objects.json``, the catalogue of distinct objects with
their splits. With ``collect.textures`` also a TextureRecord beside each mesh that has base colours, and
``files/textures.json``, which says what there is and what could not be had. Design choice: nothing native sees a file
before ``stages.graphics.geometry.load`` has checked it, and two files are one object when their surfaces agree within a
tolerance, not when rounded numbers hash alike. Paper section 3.3 (objects from Objaverse; the split is ours).
"""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from pipeline.config import StageConfig, added, count, existing_folder, runtime
from pipeline.errors import Reject, UserError
from pipeline.keys import seed_for
from pipeline.stage import Inputs, Item, MapStage, Record
from stages.graphics.arrays import pack_json, unpack_json
from stages.graphics.geometry.records import MeshRecord, TextureRecord

if TYPE_CHECKING:
    from pipeline.store import Draft


class CollectConfig(StageConfig):
    """What every source has in common."""

    max_bytes: int = Field(268435456, ge=1)  # of a file and of the buffers beside it
    max_faces: int = Field(2000000, ge=1)  # before processing
    textures: bool = added(False, legacy=False)  # keep base colours and images, for scene.textures; the meshes stay the same


class ProceduralConfig(CollectConfig):
    """Made-up shapes: works everywhere, licence-free."""

    name: Literal["procedural"] = "procedural"
    seed: int = 0
    per_family: int = count(4, ge=1, le=999)  # objects of each family
    test_families: list[str] = ["mug", "torus_knot"]  # held out whole, in test
    validation_families: list[str] = ["gear"]  # held out whole, in validation


class FolderConfig(CollectConfig):
    """Mesh files below a folder."""

    name: Literal["folder"] = "folder"
    path: str | None = runtime(None)  # collect.path=DIR; the content of its files is what counts
    pattern: str = "**/*"  # which files, relative to the folder
    licence: str = ""  # of all files; "" for what the file or the folder's README says
    origin: str = ""  # likewise


class ObjaverseConfig(CollectConfig):
    """Objects of Objaverse 1.0 by id, downloaded by its own package (`pip install objaverse`)."""

    name: Literal["objaverse"] = "objaverse"
    ids: list[str] = count([])  # uids
    ids_file: str | None = runtime(None)  # or a file with one uid per line; its content counts, not its path
    revision: str = "hf-objaverse-v1"  # of the dataset; the name of the package's cache folder


class Collect(MapStage):
    name: ClassVar[str] = "collect"
    version: ClassVar[int] = 4
    Config: ClassVar[Any] = Annotated[ProceduralConfig | FolderConfig | ObjaverseConfig, Field(discriminator="name")]
    reasons: ClassVar[dict[str, str]] = {
        "unreadable": "the file is truncated, malformed or not what its suffix says",
        "unsupported": "the file requires a feature that is not supported",
        "needs_draco": "the file requires Draco compression and the package DracoPy is not installed",
        "needs_package": "the file's format is read by a package that is not installed",
        "unsafe_path": "the file refers to, or is, something outside its folder",
        "too_large": "the file, or the geometry that it states, is over the configured limits",
        "no_faces": "there is no triangle in it",
        "not_finite": "a vertex in use is infinite or not a number",
        "bad_indices": "a face refers to a vertex that does not exist",
        "degenerate": "no area, or too small or too far from the origin for its numbers",
        "too_large_extent": "coordinates so large that lengths and areas cannot be computed",
        "too_thin": "a hair or a sliver: next to no area for its length",
        "unavailable": "the source does not have an object of that id",
        "duplicate": "the same geometry as another object",
    }
    limits: ClassVar[dict[str, float]] = {"cpu_s": 120.0, "wall_s": 600.0, "memory_gb": 6.0}

    def slug(self, config: StageConfig) -> str:
        return config.name

    def identity(self, config: StageConfig, hash_file: Callable[[Any], str]) -> dict[str, Any]:
        if config.name == "folder":
            return _hashes(config, hash_file)
        if config.name == "objaverse":
            return {"items": dict.fromkeys(objaverse_ids(config), config.revision)}
        return {}

    def items(self, config: StageConfig, inputs: Inputs) -> Iterable[Item]:
        if config.name == "procedural":
            from stages.renderformer.objects.procedural import FAMILIES

            unknown = sorted({*config.test_families, *config.validation_families} - set(FAMILIES))
            in_both = sorted(set(config.test_families) & set(config.validation_families))
            if unknown or in_both:
                raise UserError(
                    f"held-out families {unknown or in_both}: "
                    + (f"known are {', '.join(sorted(FAMILIES))}" if unknown else "each can be held out in one split only")
                )
            return [Item(f"{family}-{number:03d}") for family in FAMILIES for number in range(config.per_family)]
        if config.name == "folder":
            return [Item(relative) for relative in mesh_files(config)]
        return [Item(uid) for uid in objaverse_ids(config)]

    def open(self, config: StageConfig, inputs: Inputs, environment: dict[str, Any]) -> Any:
        from stages.graphics.geometry import one_thread

        one_thread()
        return _Collector(config)

    def process(self, worker: Any, item: Item) -> Iterator[Record]:
        mesh, texture, notes = worker.collect(item)
        yield mesh.to_record()
        # beside the mesh, not in it: what was made of the mesh is not made again because colours were kept
        members = dict(texture.to_record().members) if texture is not None else {}
        if notes:
            members["notes.json"] = pack_json(notes)
        if members:
            yield Record(mesh.id + TextureRecord.SUFFIX, members)

    def finish(self, config: StageConfig, inputs: Inputs, draft: Draft) -> None:
        from stages.renderformer.objects import catalogue

        beside = {row.id for row in draft.rows() if row.id.endswith(TextureRecord.SUFFIX)}
        rows = {row.id: row for row in draft.rows() if row.id not in beside}
        objects, signatures = {}, {}
        for name in sorted(rows):
            meta = MeshRecord.from_record(draft.read(name)).meta
            signatures[name] = meta.pop("signature")
            objects[name] = {key: meta[key] for key in CATALOGUE_FIELDS}

        def mesh(name: str) -> tuple[np.ndarray, np.ndarray]:
            record = MeshRecord.from_record(draft.read(name))
            return record.vertices.astype(np.float64), record.faces.astype(np.int64)

        same: dict[str, str] = {}
        if objects:
            order = sorted(objects, key=lambda name: rows[name].item)
            same = catalogue.find_duplicates(order, np.array([signatures[name] for name in order]), mesh)
        left_out: dict[str, list[str]] = {}  # object -> content hashes of its duplicates
        for name, first in sorted(same.items()):
            left_out.setdefault(first, []).append(objects.pop(name)["content_hash"])
            draft.reject(rows[name].item, "duplicate", f"same geometry as {rows[first].item}")
        fixed_splits = {}
        if config.name == "procedural":
            of_family = {family: "test" for family in config.test_families}
            of_family |= {family: "validation" for family in config.validation_families}
            fixed_splits = {name: of_family[o["family"]] for name, o in objects.items() if o["family"] in of_family}
        splits = catalogue.fill_splits(list(objects.values()), fixed_splits, left_out)
        listed = [{**objects[name], "split": splits[name]} for name in sorted(objects)]
        (draft.files / "objects.json").write_bytes(pack_json(listed))
        if config.textures:
            textures_json = {}
            for name in sorted(objects):
                id = name + TextureRecord.SUFFIX
                members = draft.read(id).members if id in beside else {}
                notes = unpack_json(members["notes.json"]) if "notes.json" in members else []
                textures_json[name] = {"textured": "texture.npz" in members, "notes": notes}
            (draft.files / "textures.json").write_bytes(pack_json(textures_json))
            number = sum(entry["textured"] for entry in textures_json.values())
            draft.note("textures", {"textured": number, "plain": len(textures_json) - number})
        draft.note(
            "summary",
            {
                "objects": len(listed),
                "splits": dict(sorted(Counter(splits.values()).items())),
                "families": len({o["family"] for o in listed if o["family"]}),
                "held_out": {o["family"]: splits[o["object_id"]] for o in listed if o["object_id"] in fixed_splits},
                "duplicates": len(same),
                "faces": catalogue.spread([o["faces"] for o in listed]),
                "licences": dict(sorted(Counter(o["licence"] or "unknown" for o in listed).items())),
            },
        )


CATALOGUE_FIELDS = ("object_id", "content_hash", "family", "source", "origin", "licence", "faces")


class _Collector:
    """A worker: one source item to a normalised MeshRecord and, where asked for, its TextureRecord."""

    def __init__(self, config: StageConfig):
        self.config = config
        self.notes: dict[str, str] = {}
        if config.name == "folder":
            from stages.renderformer.objects.catalogue import read_notes

            self.notes = read_notes(_folder(config) / "README.md")

    def collect(self, item: Item) -> tuple[MeshRecord, TextureRecord | None, list[str]]:
        from stages.graphics.geometry import load, measure
        from stages.renderformer.objects import catalogue

        meta: dict[str, Any] = {"family": "", "origin": "", "licence": "", "source": item.id}
        config = self.config
        if config.name == "procedural":
            from stages.renderformer.objects.procedural import FAMILIES

            family = item.id.rpartition("-")[0]
            rng = np.random.default_rng(seed_for(config.seed, Collect.name, item.id))
            vertices, faces = FAMILIES[family](rng)
            vertices, faces = load.checked(vertices, faces, config.max_faces)
            mesh, stem = load.Loaded(vertices, faces), item.id
            if config.textures:
                rng = np.random.default_rng(seed_for(config.seed, f"{Collect.name}.texture", item.id))
                mesh.texture = made_up_texture(vertices, faces, rng)
            meta |= {"family": family, "source": "procedural", "origin": "made by lightmill", "licence": "CC0-1.0"}
        elif config.name == "folder":
            root = _folder(config)
            mesh = load.load_mesh(root / item.id, root, config.max_bytes, config.max_faces, config.textures)
            stem = PurePosixPath(item.id).stem
            note = catalogue.note_for(item.id, self.notes)
            meta["licence"] = config.licence or mesh.about.get("licence") or note
            meta["origin"] = config.origin or mesh.about.get("origin") or note
        else:
            path, facts = _download(item.id)
            mesh = load.load_mesh(path, path.parent, config.max_bytes, config.max_faces, config.textures)
            stem = "objaverse"
            meta |= facts
        vertices = load.normalise(mesh.vertices)
        name = catalogue.record_id(item.id, stem)
        meta |= {
            "object_id": name,
            "content_hash": measure.content_hash(vertices, mesh.faces),
            "parts": mesh.parts,
            "faces": len(mesh.faces),
            "signature": measure.signature(vertices, mesh.faces),
        }
        if mesh.texture is not None:
            mesh.texture.id = name + TextureRecord.SUFFIX
        return MeshRecord(name, vertices, mesh.faces.astype(np.int32), meta), mesh.texture, mesh.notes[:20]


def made_up_texture(vertices: np.ndarray, faces: np.ndarray, rng: np.random.Generator) -> TextureRecord:
    """A pattern on all sides of a made-up mesh."""
    from stages.renderformer.objects.procedural import box_coordinates, pattern

    uv = box_coordinates(vertices, faces, float(rng.uniform(1, 3))).astype(np.float32)
    white, first = np.ones((1, 3), np.float32), np.zeros(1, np.int16)
    return TextureRecord("", uv, np.zeros(len(faces), np.int16), white, first, np.zeros((1, 2), np.uint8), [pattern(rng)])


# -- folder


def _folder(config: FolderConfig) -> Path:
    return existing_folder("collect.path", config.path, "collect=folder needs a folder")


def mesh_files(config: FolderConfig) -> list[str]:
    """Relative POSIX paths of the mesh files below the folder, sorted. Linked folders are not entered."""
    from stages.graphics.geometry.load import EXPORTS, SUFFIXES

    root = _folder(config)
    mesh_paths, exports = [], set()
    for folder, folders, files in os.walk(root):
        folders.sort()
        for name in files:
            relative = (Path(folder) / name).relative_to(root)
            exports |= {relative.suffix.lower()} & EXPORTS.keys()
            if relative.suffix.lower() in SUFFIXES and (
                config.pattern == "**/*" or PurePosixPath(relative.as_posix()).match(config.pattern)
            ):
                mesh_paths.append(relative.as_posix())
    if not mesh_paths:
        hints = "".join(f"; {suffix} is not read: {EXPORTS[suffix]}" for suffix in sorted(exports))
        raise UserError(
            f"collect.path={config.path!r} holds no mesh matching {config.pattern!r} ({', '.join(SUFFIXES)}){hints}"
        )
    return sorted(mesh_paths)


def _hashes(config: FolderConfig, hash_file: Callable[[Any], str]) -> dict[str, Any]:
    """Content of all that decides the output: per mesh file its hash and those of the buffers, and with textures of
    the libraries and images, that it names; the README."""
    from stages.graphics.geometry import side_files
    from stages.graphics.geometry.paths import inside

    root = _folder(config)

    def content(relative: str) -> str:
        return hash_file(root / relative) if inside(root / relative, root) else "outside"

    items: dict[str, Any] = {}
    for relative in mesh_files(config):
        path = root / relative
        beside: list[Path] = []
        if inside(path, root):
            beside = (
                side_files.buffers(path, root)
                + side_files.layers(path, root)
                + (side_files.colours(path, root) if config.textures else [])
            )
        names = [target.resolve().relative_to(root.resolve()).as_posix() for target in beside]
        items[relative] = [content(relative), {name: content(name) for name in names}] if names else content(relative)
    return {"items": items, "readme": content("README.md") if (root / "README.md").is_file() else None}


# -- Objaverse


def objaverse_ids(config: ObjaverseConfig) -> list[str]:
    """The uids asked for, sorted, each once."""
    ids = list(config.ids)
    if config.ids_file is not None:
        try:
            ids += Path(config.ids_file).expanduser().read_text(encoding="utf-8").split()
        except OSError as error:
            raise UserError(f"collect.ids_file={config.ids_file!r} cannot be read: {error.strerror}") from None
    if not ids:
        raise UserError("collect=objaverse needs collect.ids=[UID,...] or collect.ids_file=FILE with one uid per line")
    return sorted(set(ids))


def _download(uid: str) -> tuple[Path, dict[str, str]]:
    """The object's file in the package's own cache, and what the annotations say of it."""
    try:
        import objaverse
    except ImportError:
        raise UserError("collect=objaverse needs the package objaverse: pip install objaverse") from None
    paths = objaverse.load_objects([uid], download_processes=1)
    if uid not in paths:
        raise Reject("unavailable", f"Objaverse has no object {uid!r}")
    path = Path(paths[uid])
    notes = objaverse.load_annotations([uid]).get(uid, {})
    user = notes.get("user", {}).get("displayName", "") if isinstance(notes.get("user"), dict) else ""
    origin = " by ".join(str(part) for part in (notes.get("viewerUrl") or notes.get("uri") or "", user) if part)
    return path, {
        "source": f"objaverse/{uid}",
        "licence": str(notes.get("license") or ""),
        "origin": origin,
        "download_hash": hashlib.blake2b(path.read_bytes(), digest_size=32).hexdigest(),
    }
