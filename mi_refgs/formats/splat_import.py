"""Splat files of other programs, read as a scene: those of 3DGS, of 2DGS, and of their descendants.

Their colours are blended display-encoded (`shade.reflectance.radiance`). Two differences to 2DGS: its screen
filter has a variance of 1/2 pixel², ours 1/12; and it sorts surfels by their centres."""

from __future__ import annotations

import gzip
import importlib.util
import math
import re
import subprocess
import sys
import tempfile
import zlib
from pathlib import Path

import numpy as np

from mi_refgs.constants import RAW_LIMIT
from mi_refgs.errors import InputError
from mi_refgs.io.files import require_file
from mi_refgs.io.images import linear_from_srgb
from mi_refgs.io.ply import Header, read_header, read_rows
from mi_refgs.io.progress import warn
from mi_refgs.methods.method import DataOptions, Method, Stage, SurfelOptions
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.light.maps import Learnt
from mi_refgs.shade.shading import Shading
from mi_refgs.surfels.attributes import ATTRIBUTES, MAX_SH_DEGREE, SH_DC, logit, sigmoid
from mi_refgs.surfels.ply import decode_ply
from mi_refgs.surfels.table import Surfels

EXPECTED = "the PLY file of 3DGS or 2DGS"  # what messages say to give
NEEDED = "x y z opacity scale_0 scale_1 rot_0 rot_1 rot_2 rot_3 f_dc_0 f_dc_1 f_dc_2"
SPLAT = re.compile(r"[xyz]|opacity|filter_3D|refl_strength|(scale|rot|f_dc|f_rest)_\d+")  # what is read
MATERIALS = re.compile(r"roughness|(ori_color|ind_dc|ind_rest)_\d+")  # more that is read of Ref-Gaussian's
OURS = {"refl_strength": "metallic", **{f"ori_color_{i}": f"albedo_{i}" for i in range(3)}}  # by their names
FOREIGN = re.compile(
    r"metallic|(albedo|tint|offset|ind_dc|f_anchor_feat)_0"
)  # what colours alone do not show
UNUSED = {"nx", "ny", "nz", "red", "green", "blue"}  # zeros, and copies of f_dc
ANTIALIASED = re.compile(r"SplatRenderMode:\s*mip|antialias\w*\s+1|train_flags.*antialias", re.IGNORECASE)
"""Comments of Brush, gsplat and nerfstudio; of Postshot; of 3DGS."""
MAGIC = {b"\x1f\x8b": "spz", b"NGSP": "spz", b"PK\x03\x04": "sog"}  # first bytes of compressed splats
CONVERT = "import sys, gaussforge as g; data = open(sys.argv[2], 'rb').read(); \
open(sys.argv[3], 'wb').write(g.GaussForge().convert(data, sys.argv[1], 'ply')['data'])"
SECONDS = 300  # that a conversion may take: damaged files can hang it
ENDS = 20.0  # logit for an infinite opacity, and minus the log of a deviation of 0: other programs' limit
ODD = (0, 1, 3, 6, 8, 10, 11, 13)  # SH functions from degree 1 on that half a turn around x negates
BRIGHTEST = 1e6  # display-encoded colour whose linear radiance fits float32


def read_splats(path: Path, linear: bool = False, light: EnvironmentLight | None = None) -> TrainedScene:
    """Read 3D Gaussians or surfels, and warn of what is left out or replaced. `linear`: their colours are
    linear radiance, as ours. `light`: of materials (Ref-Gaussian, 3DGS-DR); otherwise it is constant."""
    require_file(path)
    with tempfile.TemporaryDirectory(prefix="refgs_") as folder:
        plain, flags = _plain(path, Path(folder) / "plain.ply")
        with plain.open("rb") as file:
            header = read_header(path, file, EXPECTED)
            rows = read_rows(path, file, header)
    columns = _columns(path, header, rows)
    notes, names = _repair(path, columns), rows.dtype.names or ()
    if unread := {re.sub(r"_\d+$", "", x) for x in names if not {x, OURS.get(x)} & {*columns}} - UNUSED:
        notes.append(f"not read: {', '.join(sorted(unread))}")
    if flags is not None:  # SPZ has +y up and +z backward: half a turn around x
        each = sum(name.startswith("f_rest_") for name in columns) // 3
        turned = [f"f_rest_{c * each + k}" for c in range(3) for k in ODD if k < each]
        columns |= {name: -columns[name] for name in ("y", "z", "rot_2", "rot_3", *turned)}
    if (flags or 0) & 1 or "filter_3D" in columns or any(map(ANTIALIASED.search, header.comments)):
        notes.append("fitted with an antialiasing filter and drawn without: small Gaussians are too opaque")
    surfels = decode_ply(path, columns)
    shading = Shading("surfel", "radiance") if linear else Shading("pixel", "displayed")
    if "metallic" in columns:
        shading = Shading("pixel", "split_sum" if "albedo_0" in columns else "mirror").antialiased()
        surfels = surfels if linear else _linear(surfels)
        if light is None:
            light = EnvironmentLight.constant(1.0)
            notes.append(
                "its light, in another file that only PyTorch reads, is 1 here: give one by --envmap"
            )
    elif light is not None:
        raise InputError("it has colours only, which no light changes", path, "--envmap", "leave it out")
    if notes:
        warn(f"{path}: {'; '.join(notes)}")
    return TrainedScene(surfels, light, None, shading, iteration=0, seconds=0.0)


def _plain(path: Path, target: Path) -> tuple[Path, int | None]:
    """The file, or `target` written from a compressed one by another process, since the library may crash;
    and the flags of an SPZ file, whose lowest bit is its antialiasing filter."""
    with path.open("rb") as file:
        first = file.read(4096)
    kind = next((kind for magic, kind in MAGIC.items() if first.startswith(magic)), None)
    if path.suffix.lower() in (".splat", ".ksplat"):
        kind = path.suffix.lower()[1:]
    if first.startswith(b"ply"):
        kind = "compressed.ply" if b"packed_position" in first else None
    if kind is None or b"data.pkl" in first:  # a zip archive of PyTorch
        return path, None
    what, remedy = f"compressed splats ({kind})", f"convert it: `splat-transform {path.name} plain.ply`"
    if importlib.util.find_spec("gaussforge") is None:
        raise InputError(what, path, "header", f'pip install "mi_refgs[splats]", or {remedy}')
    try:
        head = gzip.open(path).read(15) if first.startswith(b"\x1f\x8b") else first
        if kind == "spz" and not head.startswith(b"NGSP"):
            raise InputError("a compressed file, but not SPZ", path, "header", "decompress it first")
        command = [sys.executable, "-c", CONVERT, kind, str(path), str(target)]
        subprocess.run(command, check=True, capture_output=True, timeout=SECONDS)
        return target, head[14] if kind == "spz" else None
    except (OSError, EOFError, IndexError, zlib.error, subprocess.SubprocessError) as error:
        remedy = f"export it again, or {remedy}"
        raise InputError(f"{what}, which cannot be read", path, "header", remedy) from error


def _columns(path: Path, header: Header, rows: np.ndarray) -> dict[str, np.ndarray]:
    """Return columns (N,) float32 by our names; raises InputError for what is no splat."""
    names = rows.dtype.names or ()
    materials = {*OURS, "roughness"} <= {*names}
    if not {"opacity", "scale_0", "rot_0"} & {*names}:
        kind = "points with colours" if "red" in names else "points without size or opacity"
        kind = "a mesh" if any(element.name == "face" for element in header.elements) else kind
        raise InputError(f"{kind}, no Gaussians", path, "vertex", f"give {EXPECTED}")
    if not materials and (foreign := sorted(filter(FOREIGN.fullmatch, names))):
        what, remedy = "materials, which require their light and shading", "give the run folder instead"
        if foreign[0] == "f_anchor_feat_0":
            what, remedy = "anchors of Scaffold-GS", "export the Gaussians that its networks make of them"
        raise InputError(what, path, foreign[0], remedy)
    with np.errstate(over="ignore"):  # a double beyond float32 becomes infinite
        read = [x for x in names if SPLAT.fullmatch(x) or (materials and MATERIALS.fullmatch(x))]
        # 16-bit integers are the bits of half floats, which PLY lacks.
        half = {x: rows[x].astype("u2").view("f2") for x in read if rows.dtype[x].str[1:] == "u2"}
        columns = {OURS.get(x, x): half.get(x, rows[x]).astype(np.float32) for x in read}
    if "f_dc_0" not in names and {"red", "green", "blue"} <= {*names}:  # nerfstudio's colour mode "rgb"
        most = 1 if rows.dtype["red"].kind == "f" else 255
        for i, name in enumerate(("red", "green", "blue")):
            columns[f"f_dc_{i}"] = ((rows[name] / most - 0.5) / SH_DC).astype(np.float32)
    if missing := [name for name in NEEDED.split() if name not in columns]:
        raise InputError("the property is missing", path, missing[0], "export the file again with it")
    return columns


@np.errstate(all="ignore")  # unusable rows
def _repair(path: Path, columns: dict[str, np.ndarray]) -> list[str]:
    """Make columns usable: leave out rows, fuse filters, cut SH; return what a user should know of it.

    Mip-Splatting's filter_3D: with its variance f², deviations become √(s² + f²), and opacities shrink by
    Π s / √(s² + f²). [Yu et al. 2024, eq. 9]"""
    notes, scales, count = [], [name for name in columns if name.startswith("scale_")], len(columns["x"])
    if not count:
        raise InputError("there are none", path, "vertex", "export the file again")
    if all((columns[name] > 0).all() for name in scales) and (abs(columns["opacity"] - 0.5) <= 0.5).all():
        notes.append("scales and opacities are activated: their logarithms and logits are used")
        columns |= {name: np.log(columns[name]) for name in scales} | {"opacity": logit(columns["opacity"])}
    # Infinite logits, logarithms of 0.
    for name in ("opacity", *scales):
        most = ENDS if name == "opacity" else np.inf
        clamped = np.nan_to_num(columns[name], nan=np.nan, posinf=most, neginf=-ENDS)
        if changed := np.count_nonzero(np.isinf(columns[name]) & ~np.isinf(clamped)):
            notes.append(f"{name}: {changed} infinite values are clamped to {ENDS:g}")
        columns[name] = clamped
    if "filter_3D" in columns:
        variance = np.exp([2.0 * columns[name] for name in scales])
        filtered = variance + columns["filter_3D"].astype(np.float64) ** 2
        columns["opacity"] = logit(sigmoid(columns["opacity"]) * np.sqrt(variance / filtered).prod(axis=0))
        columns |= dict(zip(scales, 0.5 * np.log(filtered), strict=True))
    # Rows without position, size or rotation.
    finite = np.all([np.abs(column) < RAW_LIMIT for column in columns.values()], axis=0)
    kept = finite & np.any([columns[f"rot_{i}"] for i in range(4)], axis=0)
    if left_out := count - np.count_nonzero(kept):
        bad = count - np.count_nonzero(finite)
        what = f"{left_out} of {count} rows: {bad} with NaN or infinity, {left_out - bad} with zero rotation"
        if left_out == count:
            raise InputError(f"unusable are {what}", path, "vertex", "export the file again")
        notes.append(f"left out {what}")
        columns |= {name: column[kept] for name, column in columns.items()}
    rest = sorted((name for name in columns if name.startswith("f_rest_")), key=lambda name: int(name[7:]))
    each, most = len(rest) // 3, (MAX_SH_DEGREE + 1) ** 2 - 1  # per channel
    if each > most and math.isqrt(each + 1) ** 2 == each + 1:
        notes.append(f"SH degree {math.isqrt(each + 1) - 1} is cut to {MAX_SH_DEGREE}")
        cut = [columns.pop(name) for name in rest]
        columns |= {f"f_rest_{c * most + k}": cut[c * each + k] for c in range(3) for k in range(most)}
    return notes


def _linear(surfels: Surfels) -> Surfels:
    """Convert display-encoded albedos and SH colours, as Ref-Gaussian fits them, to linear ones: mean colours
    exactly, changes with direction to first order. What is diffuse or metal then looks the same."""
    raw, step = surfels.to_numpy(), 1e-3
    for name, offset in (("radiance_sh", 0.5), ("indirect_sh", 0.0)):
        if name in raw:
            mean = np.clip(offset + SH_DC * raw[name][:, :3], 0, BRIGHTEST)
            slope = (linear_from_srgb(mean + step) - linear_from_srgb(mean)) / step
            raw[name] *= np.tile(slope, raw[name].shape[1] // 3)
            raw[name][:, :3] = (linear_from_srgb(mean) - offset) / SH_DC
    if "albedo" in raw:
        raw["albedo"] = logit(linear_from_srgb(sigmoid(raw["albedo"])))
    return Surfels.from_numpy(raw)


def method_of(trained: TrainedScene, name: str) -> Method:
    """Describe a scene that was fitted elsewhere as a method, for config.toml: how it is shaded."""
    surfels, stages = trained.surfels, {"imported": Stage(1, trained.shading)}
    count, attributes = surfels.count, tuple(x for x in surfels.raw if x not in surfels.primitive.widths)
    degree = {x: surfels.sh_degree(x) for x in attributes if ATTRIBUTES[x].harmonics}
    options = SurfelOptions(surfels.primitive.name, attributes, count, count, degree=degree)
    light = None if trained.light is None else Learnt(height=trained.light.height)
    return Method(1, stages, surfels=options, light=light, data=DataOptions(downscale=1), name=name)
