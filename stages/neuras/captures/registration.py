"""Poses and points of images by pycolmap, as a program of its own: ``python -P registration.py JOB``.

It imports nothing of the project. JOB is a JSON file: images (folder), names, one_camera, sequential, side (pixels that
features are looked for at), masks (folder, or null), folder (where the model goes, below ``sparse/0``). A process of its own,
because a fault in native code then costs no run.
"""

from __future__ import annotations

import json
import shutil
import sys
import time
from pathlib import Path

SEED = 0


def main(job_file: Path) -> None:
    """Write the largest model, and ``times.json``: seconds of each step."""
    import pycolmap

    job = json.loads(job_file.read_text())
    images, folder = job["images"], Path(job["folder"])
    database, models = folder / "database.db", folder / "models"
    database.unlink(missing_ok=True)
    shutil.rmtree(models, ignore_errors=True)
    models.mkdir()
    pycolmap.set_random_seed(SEED)
    times, began = {}, time.perf_counter()

    def lap(name: str) -> None:
        nonlocal began
        times[name], began = round(time.perf_counter() - began, 1), time.perf_counter()

    extraction, matching = pycolmap.FeatureExtractionOptions(), pycolmap.FeatureMatchingOptions()
    extraction.max_image_size = job["side"]
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    mode = pycolmap.CameraMode.SINGLE if job["one_camera"] else pycolmap.CameraMode.AUTO
    pycolmap.extract_features(
        database,
        images,
        image_names=job["names"],
        camera_mode=mode,
        reader_options=pycolmap.ImageReaderOptions(camera_model="OPENCV", mask_path=job["masks"] or ""),
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )
    lap("features")
    match = pycolmap.match_sequential if job["sequential"] else pycolmap.match_exhaustive
    match(database, matching_options=matching, verification_options=verification, device=pycolmap.Device.cpu)
    lap("matching")
    options = pycolmap.IncrementalPipelineOptions(
        random_seed=SEED,
        num_threads=1,  # sums in another order end elsewhere
        min_model_size=min(10, max(len(job["names"]) // 2, 3)),
        extract_colors=False,
    )
    found = pycolmap.incremental_mapping(database, images, models, options=options)
    lap("mapping")
    (folder / "times.json").write_text(json.dumps(times))
    if found:
        best = max(found.values(), key=lambda model: model.num_reg_images())
        whole = folder / "sparse" / "0"
        shutil.rmtree(whole, ignore_errors=True)
        whole.mkdir(parents=True)
        best.write_binary(whole)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
