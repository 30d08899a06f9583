"""Compare this project's RenderFormer with recorded outputs of the released one: ``python checks/parity.py FOLDER...``

Each folder holds config.json, model.safetensors and case.npz (triangles, texture, mask, vn, c2w, fov in degrees, resolution,
hdr). Prints the largest difference in log10(1 + x) of each and exits with 1 if one is over the tolerance.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from model.renderformer import checkpoint  # noqa: E402
from model.renderformer.inputs import Triangles  # noqa: E402

TOLERANCE = 2e-5


def difference(folder: Path) -> float:
    """Largest absolute difference of log10(1 + x) between our output and the recorded one."""
    model, _ = checkpoint.load(folder)
    with np.load(folder / "case.npz", allow_pickle=False) as file:
        case = {name: torch.from_numpy(np.atleast_1d(file[name])) for name in file.files}
    scene = Triangles.pack(*(case[name][None] for name in ("triangles", "vn", "texture", "mask")))
    y = model.render(scene, case["c2w"][None], case["fov"].reshape(1, -1), int(case["resolution"]))[0]
    return float((y - torch.log10(1 + case["hdr"])).abs().max())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER")
    parser.add_argument("--tolerance", type=float, default=TOLERANCE, help="in log10(1 + x), default %(default)s")
    args = parser.parse_args()
    failed = 0
    for folder in args.folders:
        try:
            worst = difference(folder)
        except (OSError, ValueError, KeyError) as error:
            print(f"{folder}: {error}", file=sys.stderr)
            failed += 1
            continue
        ok = worst <= args.tolerance  # False for NaN as well
        failed += not ok
        print(f"{folder.name:28s} largest difference {worst:.3g} {'ok' if ok else f'over {args.tolerance:g}'}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
