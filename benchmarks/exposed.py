"""Puts exposures and white balances on a data set: a copy whose images each have a gain per channel.

    python -m benchmarks.exposed DATA COPY --low 0.6 --high 1.3 --seed 0

For 8-bit data sets with transforms_*.json. A gain multiplies the linear radiance of the object ahead of
the sRGB curve and 8 bits; alpha stays. gains.json contains the gains, uniform in the logarithm.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.report import plain_parser
from mi_refgs.io.files import read_json, write_json
from mi_refgs.io.images import linear_from_srgb, read_png, srgb_from_linear, write_png


def put_on(data: Path, copy: Path, low: float, high: float, seed: int) -> dict[str, list[float]]:
    """Write the copy, and return the gains by file name."""
    rng, gains = np.random.default_rng(seed), {}
    copy.mkdir(parents=True, exist_ok=True)
    for transforms in sorted(data.glob("transforms*.json")):
        content: dict[str, Any] = read_json(transforms)
        for frame in content["frames"]:
            named = data / frame["file_path"]
            file = named if named.is_file() else named.with_name(f"{named.name}.png")
            target = copy / file.relative_to(data)
            target.parent.mkdir(parents=True, exist_ok=True)
            pixels = read_png(file)
            gain = np.exp(rng.uniform(np.log(low), np.log(high), 3))
            pixels[..., :3] = srgb_from_linear(linear_from_srgb(pixels[..., :3]) * np.float32(gain))
            write_png(target, pixels)
            gains[frame["file_path"]] = gain.tolist()
            frame.pop("exr_path", None)
            for key in (key for key in frame if key.endswith("_path") and key != "file_path"):
                shutil.copyfile(data / frame[key], copy / frame[key])
        write_json(copy / transforms.name, content)
    for name in ("environment.exr", "surface.ply", "region.json"):
        if (data / name).is_file():
            shutil.copyfile(data / name, copy / name)
    write_json(copy / "gains.json", gains, indent=2)
    return gains


def main() -> None:
    """Read the command line and write the copy."""
    parser = plain_parser("exposed", __doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("copy", type=Path)
    parser.add_argument("--low", type=float, default=0.6)
    parser.add_argument("--high", type=float, default=1.3)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    print(f"{args.copy}: {len(put_on(args.data, args.copy, args.low, args.high, args.seed))} images")


if __name__ == "__main__":
    main()
