"""Measure what collect, remesh and decimate made of meshes, with nothing of the stages' own measures. Run by hand:

    python checks/geometry.py --store STORE [--sheet worst.png] [collect=folder collect.path=DIR remesh.resolution=128 ...]

Makes the decimate artifact that the overrides describe, where the store does not have it, and reads the meshes back from the
artifacts. Per object: the remeshed mesh and every rung are checked for closedness, manifold edges, degenerate faces, outward
components and face count, and compared with the original's outer surface, which is what rays from outside in 64 directions
meet first. Prints the distributions and the worst ten, with ``--sheet`` their pictures, and exits with 1 where a mesh is
unsound or a median misses the bar.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import subprocess
import sys
from pathlib import Path

for name in ("OMP_NUM_THREADS", "IGL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import numpy as np  # noqa: E402

from pipeline.hydra_config import compose  # noqa: E402
from pipeline.plan import plan_run  # noqa: E402
from pipeline.store import Artifact, Store, iter_inputs  # noqa: E402
from stages.graphics.geometry import sheet  # noqa: E402
from stages.graphics.geometry.records import MeshRecord  # noqa: E402
from stages.renderformer.objects.rungs import load_rungs  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]
POINTS = 10_000  # per surface
TOLERANCE = 1e-4  # of the diagonal: a ray that first meets the surface so close to a point has reached it
BAR = {128: {"remeshed": 0.002, "1024": 0.003}, 256: {"remeshed": 0.001, "1024": 0.002}}  # grid -> median distance
KEPT_BAR, INSIDE_BAR = (0.99, 0.9), 0.005  # median and 10th percentile; median
Mesh = tuple[np.ndarray, np.ndarray]


def directions() -> np.ndarray:
    """(64, 3) unit vectors, spread by repulsion from a fixed random start: not the stages' lattice."""
    points = np.random.default_rng(64).normal(size=(64, 3))
    for _ in range(200):
        points /= np.linalg.norm(points, axis=1, keepdims=True)
        apart = points[:, None] - points[None]
        points += 0.02 * (apart / (np.linalg.norm(apart, axis=2, keepdims=True) ** 3 + 1e-9)).sum(axis=1)
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def sampled(mesh: Mesh, seed: int) -> np.ndarray:
    """(POINTS, 3) uniform on the surface."""
    rng = np.random.default_rng(seed)
    corners = np.asarray(mesh[0], np.float64)[mesh[1]]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = corners[rng.choice(len(area), POINTS, p=area / area.sum())]
    weights = rng.dirichlet((1, 1, 1), POINTS)
    return np.einsum("nc,ncd->nd", weights, chosen)


def met_from_outside(mesh: Mesh, points: np.ndarray) -> tuple[np.ndarray, float]:
    """((N,) bool: some ray from outside meets the surface first at this point; share of first hits on a face's back)."""
    from embreex import rtcore_scene
    from embreex.mesh_construction import TriangleMesh

    corners = np.asarray(mesh[0], np.float64)[mesh[1]]
    centre, radius = corners.reshape(-1, 3).mean(axis=0), np.linalg.norm(np.ptp(corners.reshape(-1, 3), axis=0))
    scene = rtcore_scene.EmbreeScene()
    TriangleMesh(scene, ((corners - centre) / radius).astype(np.float32))
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    local, reached, backs, hits = (points - centre) / radius, np.zeros(len(points), bool), 0, 0
    for direction in directions():
        start = local - 2.0 * direction
        found = scene.run(
            start.astype(np.float32), np.broadcast_to(direction, start.shape).astype(np.float32), output=1, query="INTERSECT"
        )
        met = found["primID"] >= 0
        reached |= met & (np.abs(found["tfar"] - 2.0) < TOLERANCE)
        backs += int((normals[found["primID"][met]] @ direction > 0).sum())
        hits += int(met.sum())
    return reached, backs / max(hits, 1)


def distance(points: np.ndarray, mesh: Mesh) -> np.ndarray:
    import igl

    vertices, faces = np.ascontiguousarray(mesh[0], np.float64), np.ascontiguousarray(mesh[1], np.int64)
    return np.sqrt(igl.point_mesh_squared_distance(points, vertices, faces)[0])


def soundness(mesh: Mesh) -> dict[str, float]:
    """What must hold of every accepted mesh, by trimesh, pymeshlab and plain counting."""
    import pymeshlab
    import trimesh

    shape = trimesh.Trimesh(*mesh, process=False)
    _, uses = np.unique(np.sort(mesh[1][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0, return_counts=True)
    angles = np.degrees(shape.face_angles).min(axis=1)
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(np.asarray(mesh[0], np.float64), np.asarray(mesh[1], np.int32)))
    meshes.compute_selection_by_self_intersections_per_face()
    parts = shape.split(only_watertight=False)
    return {
        "open or non-manifold": float(not (shape.is_watertight and shape.is_winding_consistent and (uses == 2).all())),
        "degenerate faces": float((shape.area_faces <= 1e-12).sum()),
        "inward components": float(sum(part.volume <= 0 for part in parts)),
        "crossing": float(meshes.current_mesh().selected_face_number()) / len(mesh[1]),
        "components": float(len(parts)),
        "spread": float(shape.area_faces.std() / shape.area_faces.mean()),
        "min angle": float(angles.min()),
        "slivers": float((angles < 5).mean()),
    }


def measured(task: tuple[Path, Path, Path, str]) -> dict[str, dict[str, float]]:
    """Kind of mesh ("remeshed" or a budget) -> its measures, of one object."""
    collect, remesh, decimate = (Artifact(path) for path in task[:3])
    original, fine = (MeshRecord.from_record(artifact.read(task[3])) for artifact in (collect, remesh))
    meshes = {"remeshed": (fine.vertices, fine.faces)}
    if task[3] in decimate:
        meshes |= {str(budget): mesh for budget, mesh in load_rungs(decimate.read(task[3])).items()}
    before = (original.vertices, original.faces)
    diagonal = np.linalg.norm(np.ptp(original.vertices, axis=0))
    points = sampled(before, 1)
    seen, _ = met_from_outside(before, points)
    points = points[seen] if seen.any() else points
    results = {}
    for kind, mesh in meshes.items():
        back = sampled(mesh, 2)
        there = distance(points, mesh) / diagonal
        reached, flipped = met_from_outside(mesh, back)
        results[kind] = {
            "faces": float(len(mesh[1])),
            "over budget": float(kind != "remeshed" and len(mesh[1]) > int(kind)),
            "distance": float(there.mean() + (distance(back, before) / diagonal).mean()) / 2,
            "kept": float((there < 0.01).mean()),
            "inside": float(1 - reached.mean()),
            "flipped": flipped,
            **soundness(mesh),
        }
    return results


UNSOUND = ("open or non-manifold", "degenerate faces", "inward components", "over budget")
SHOWN = ("faces", "distance", "kept", "inside", "flipped", "crossing", "spread", "min angle", "slivers", "components")
PERCENT = ("distance", "kept", "inside", "flipped", "crossing", "slivers")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--store", type=Path, default=Path("store"))
    parser.add_argument("--sheet", type=Path, help="write pictures of the worst ten there (PNG)")
    parser.add_argument("overrides", nargs="*")
    arguments = parser.parse_args()
    asked = ["stage=decimate", f"store={arguments.store}", f"hydra.run.dir={arguments.store}/runs", *arguments.overrides]
    subprocess.run([sys.executable, "-m", "pipeline", *asked], check=True, cwd=ROOT)
    store = Store(arguments.store)
    planned = plan_run(compose(["stage=decimate", f"store={arguments.store}", *arguments.overrides])).stages["decimate"]
    decimate = store.find(planned.place, planned.key)
    inputs = {name: artifact for name, _, artifact in iter_inputs(store, decimate)}
    collect, remesh = inputs["collect"], inputs["remesh"]
    for artifact in (collect, remesh, decimate):
        outputs = artifact.manifest["outputs"]
        print(f"{artifact.stage}: {outputs['records']} of {outputs['items']} accepted; rejected {outputs['rejects'] or 'none'}")
    ids = sorted(row.id for row in remesh.rows())
    with multiprocessing.get_context("spawn").Pool() as pool:
        tasks = [(collect.path, remesh.path, decimate.path, id) for id in ids]
        results = dict(zip(ids, pool.imap(measured, tasks, chunksize=1), strict=True))
    return report(results, remesh.manifest["preimage"]["params"]["resolution"], arguments.sheet, (collect, remesh, decimate))


def report(results: dict, grid: int, sheet_path: Path | None, artifacts: tuple[Artifact, Artifact, Artifact]) -> int:
    kinds = sorted({kind for result in results.values() for kind in result}, key=lambda k: -1 if k == "remeshed" else int(k))
    bad = 0
    columns = ("least", "p10", "median", "mean", "p90", "most")
    print(f"\n{'grid ' + str(grid):<14} {'measure':<12} " + " ".join(f"{column:>9}" for column in columns))
    for kind in kinds:
        rows = [result[kind] for result in results.values() if kind in result]
        for name in SHOWN:
            values = np.array([row[name] for row in rows]) * (100 if name in PERCENT else 1)
            numbers = [values.min(), *np.percentile(values, [10, 50]), values.mean(), np.percentile(values, 90), values.max()]
            unit = "%" if name in PERCENT else ""
            head = f"{kind} ({len(rows)})" if name == SHOWN[0] else ""
            print(f"{head:<14} {name + ' ' + unit:<12} " + " ".join(f"{number:9.3f}" for number in numbers))
        for name in UNSOUND:
            wrong = [id for id, result in results.items() if kind in result and result[kind][name] > 0]
            bad += len(wrong)
            print(f"{'':<14} {name}: {f'{len(wrong)} MESHES: ' + ', '.join(wrong[:5]) if wrong else 'none'}")
        if kind in BAR.get(grid, {}):
            distances, kept, inside = (np.array([row[name] for row in rows]) for name in ("distance", "kept", "inside"))
            checks = {
                f"median distance {np.median(distances):.3%} of {BAR[grid][kind]:.1%}": np.median(distances) <= BAR[grid][kind],
                f"kept median {np.median(kept):.4f}": np.median(kept) >= KEPT_BAR[0],
                f"kept p10 {np.percentile(kept, 10):.4f}": np.percentile(kept, 10) >= KEPT_BAR[1],
                f"inside median {np.median(inside):.2%}": np.median(inside) <= INSIDE_BAR,
            }
            bad += sum(not good for good in checks.values())
            print(f"{'':<14} bar: " + "; ".join(f"{text} {'ok' if good else 'MISSED'}" for text, good in checks.items()))

    def badness(id: str) -> float:
        finer = [r for kind, r in results[id].items() if kind == "remeshed" or int(kind) >= 256]
        return max(r["distance"] + (1 - r["kept"]) / 10 for r in finer)

    worst = sorted(results, key=badness, reverse=True)[:10]
    print("\nworst ten, by distance + a tenth of what is lost, among remeshed and rungs from 256 faces on")
    for id in worst:
        print(id)
        for kind, r in results[id].items():
            print(f"    {kind}: {r['distance']:.2%}, kept {r['kept']:.3f}, inside {r['inside']:.1%}")
    if sheet_path is not None:
        collect, remesh, decimate = artifacts
        rows = []
        for id in worst:
            before = [MeshRecord.from_record(artifact.read(id)) for artifact in (collect, remesh)]
            rungs = load_rungs(decimate.read(id)) if id in decimate else {}
            budgets = decimate.manifest["preimage"]["params"]["budgets"]
            rows.append((id, [(m.vertices, m.faces) for m in before] + [rungs.get(b) for b in sorted(budgets, reverse=True)]))
        sheet.write_sheet(sheet_path, rows)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
