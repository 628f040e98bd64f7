"""Splat files of other programs, read as a scene: those of 3DGS, of 2DGS, and of their descendants.

Their colours are blended display-encoded (`shade.reflectance.radiance`). Two differences to 2DGS: its screen
filter has a variance of 1/2 pixel², ours 1/12; and it sorts surfels by their centres."""

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
from mi_refgs.surfels.attributes import ATTRIBUTES, MAX_SH_DEGREE, SH_DC, logit, sh_columns, sigmoid
from mi_refgs.surfels.ply import raw_attributes
from mi_refgs.surfels.table import Surfels

EXPECTED = "the PLY file of 3DGS or 2DGS"  # what messages say to give
SPLAT = re.compile(r"[xyz]|opacity|filter_3D|refl_strength|(scale|rot|f_dc|f_rest)_\d+")  # what is read
MATERIALS = re.compile(r"roughness|(ori_color|ind_dc|ind_rest)_\d+")  # more that is read of Ref-Gaussian's
OURS = {"refl_strength": "metallic", **{f"ori_color_{i}": f"albedo_{i}" for i in range(3)}}  # by their names
FOREIGN = re.compile(r"metallic|(albedo|tint|offset|ind_dc|f_anchor_feat)_0")  # no part of a colour
UNUSED = {"nx", "ny", "nz", "red", "green", "blue"}  # zeros, and copies of f_dc
ANTIALIASED = re.compile(r"SplatRenderMode:\s*mip|antialias\w*\s+1|train_flags.*antialias", re.IGNORECASE)
"""Comments of Brush, gsplat and nerfstudio; of Postshot; of 3DGS."""
MAGIC = {b"\x1f\x8b": "spz", b"NGSP": "spz", b"PK\x03\x04": "sog"}  # first bytes of compressed splats
CONVERT = "import sys, gaussforge as g; data = open(sys.argv[2], 'rb').read(); \
open(sys.argv[3], 'wb').write(g.GaussForge().convert(data, sys.argv[1], 'ply')['data'])"
SECONDS = 300  # that a conversion may take: damaged files can hang it
ENDS = 20.0  # logit for an infinite opacity, and minus the log of a deviation of 0: other programs' limit
FLIPPED = [1, 2, 4, 7, 9, 11, 12, 14]  # SH functions that half a turn around x negates
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
    raw = raw_attributes(path, columns, most=9)  # cut below
    if "radiance_sh" not in raw:
        raise InputError("the property is missing", path, "f_dc_0", "export the file again with it")
    notes, names = _repair(path, raw, columns.get("filter_3D")), rows.dtype.names or ()
    if unread := {re.sub(r"_\d+$", "", x) for x in names if not {x, OURS.get(x)} & {*columns}} - UNUSED:
        notes.append(f"not read: {', '.join(sorted(unread))}")
    if flags is not None:  # SPZ has +y up and +z backward: half a turn around x
        signs = np.ones((MAX_SH_DEGREE + 1) ** 2, np.float32)
        signs[FLIPPED] = -1
        raw["position"] *= [1, -1, -1]
        raw["rotation"] *= [1, -1, -1, 1]
        raw["radiance_sh"] *= signs.repeat(3)[: raw["radiance_sh"].shape[1]]
    if (flags or 0) & 1 or "filter_3D" in columns or any(map(ANTIALIASED.search, header.comments)):
        notes.append("fitted with an antialiasing filter and drawn without: small Gaussians are too opaque")
    shading = Shading("surfel", "radiance") if linear else Shading("pixel", "displayed")
    if "metallic" in raw:
        shading = Shading("pixel", "split_sum" if "albedo" in raw else "mirror").antialiased()
        raw = raw if linear else _linear(raw)
        if light is None:
            light = EnvironmentLight.constant(1.0)
            what = "its light, in another file that only PyTorch reads, is 1 here: give one by --envmap"
            notes.append(what)
    elif light is not None:
        raise InputError("it has colours only, which no light changes", path, "--envmap", "leave it out")
    if notes:
        warn(f"{path}: {'; '.join(notes)}")
    return TrainedScene(Surfels.from_numpy(raw), light, None, shading, iteration=0, seconds=0.0)


def _plain(path: Path, target: Path) -> tuple[Path, int | None]:
    """The file, or `target` written from a compressed one by another process, since the library may crash;
    and the flags of an SPZ file, whose lowest bit is its antialiasing filter."""
    with path.open("rb") as file:
        first = file.read(4096)
    kind = next((kind for magic, kind in MAGIC.items() if first.startswith(magic)), None)
    if first.startswith(b"ply"):
        kind = "compressed.ply" if b"packed_position" in first else None
    elif path.suffix.lower() in (".splat", ".ksplat"):
        kind = path.suffix.lower()[1:]
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
    """Return columns (N,) by our names; raises InputError for what is no splat."""
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
    columns = {}
    for name in names:
        if SPLAT.fullmatch(name) or (materials and MATERIALS.fullmatch(name)):
            # 16-bit integers are the bits of half floats, which PLY lacks.
            half = rows.dtype[name].str[1:] == "u2"
            columns[OURS.get(name, name)] = rows[name].astype("u2").view("f2") if half else rows[name]
    if "f_dc_0" not in names and {"red", "green", "blue"} <= {*names}:  # nerfstudio's colour mode "rgb"
        most = 1 if rows.dtype["red"].kind == "f" else 255
        for i, name in enumerate(("red", "green", "blue")):
            columns[f"f_dc_{i}"] = (rows[name] / most - 0.5) / SH_DC
    return columns


@np.errstate(all="ignore")  # unusable rows
def _repair(path: Path, raw: dict[str, np.ndarray], filter_3d: np.ndarray | None) -> list[str]:
    """Make raw attributes usable: leave out rows, fuse filters, cut SH; return what a user should know of it.

    Mip-Splatting's filter_3D: with its variance f², deviations become √(s² + f²), and opacities shrink by
    Π s / √(s² + f²). [Yu et al. 2024, eq. 9]"""
    notes, (count, columns) = [], raw["radiance_sh"].shape
    if not count:
        raise InputError("there are none", path, "vertex", "export the file again")
    if columns > (most := sh_columns(MAX_SH_DEGREE)):
        notes.append(f"SH degree {math.isqrt(columns // 3) - 1} is cut to {MAX_SH_DEGREE}")
        raw["radiance_sh"] = raw["radiance_sh"][:, :most]
    if (raw["scale"] > 0).all() and (abs(raw["opacity"] - 0.5) <= 0.5).all():
        notes.append("scales and opacities are activated: their logarithms and logits are used")
        raw |= {"scale": np.log(raw["scale"]), "opacity": logit(raw["opacity"])}
    for name, end in (("opacity", ENDS), ("scale", np.inf)):  # infinite logits, logarithms of 0
        clamped = np.nan_to_num(raw[name], nan=np.nan, posinf=end, neginf=-ENDS)
        if changed := np.count_nonzero(np.isinf(raw[name]) & ~np.isinf(clamped)):
            notes.append(f"{name}: {changed} infinite values are clamped to {ENDS:g}")
        raw[name] = clamped
    if filter_3d is not None:
        variance = np.exp(2.0 * raw["scale"])
        filtered = variance + filter_3d.astype(np.float64)[:, None] ** 2
        shrunk = np.sqrt(variance / filtered).prod(axis=1, keepdims=True)
        raw |= {"scale": 0.5 * np.log(filtered), "opacity": logit(sigmoid(raw["opacity"]) * shrunk)}
    # Rows without position, size or rotation.
    finite = np.all([(np.abs(table) < RAW_LIMIT).all(axis=1) for table in raw.values()], axis=0)
    kept = finite & raw["rotation"].any(axis=1)
    if left_out := count - np.count_nonzero(kept):
        bad = count - np.count_nonzero(finite)
        what = f"{left_out} of {count} rows: {bad} with NaN or infinity, {left_out - bad} with zero rotation"
        if left_out == count:
            raise InputError(f"unusable are {what}", path, "vertex", "export the file again")
        notes.append(f"left out {what}")
        raw |= {name: table[kept] for name, table in raw.items()}
    return notes


def _linear(raw: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Convert display-encoded albedos and SH colours, as Ref-Gaussian fits them, to linear ones: mean colours
    exactly, changes with direction to first order. What is diffuse or metal then looks the same."""
    linear, step = dict(raw), 1e-3
    for name, offset in (("radiance_sh", 0.5), ("indirect_sh", 0.0)):
        if name in raw:
            mean = np.clip(offset + SH_DC * raw[name][:, :3], 0, BRIGHTEST)
            slope = (linear_from_srgb(mean + step) - linear_from_srgb(mean)) / step
            linear[name] = raw[name] * np.tile(slope, raw[name].shape[1] // 3)
            linear[name][:, :3] = (linear_from_srgb(mean) - offset) / SH_DC
    if "albedo" in raw:
        linear["albedo"] = logit(linear_from_srgb(sigmoid(raw["albedo"])))
    return linear


def method_of(trained: TrainedScene, name: str) -> Method:
    """Describe a scene that was fitted elsewhere as a method, for config.toml: how it is shaded."""
    surfels, stages = trained.surfels, {"imported": Stage(1, trained.shading)}
    count, attributes = surfels.count, tuple(x for x in surfels.raw if x not in surfels.primitive.widths)
    degree = {x: surfels.sh_degree(x) for x in attributes if ATTRIBUTES[x].harmonics}
    options = SurfelOptions(surfels.primitive.name, attributes, count, count, degree=degree)
    light = None if trained.light is None else Learnt(height=trained.light.height)
    return Method(1, stages, surfels=options, light=light, data=DataOptions(downscale=1), name=name)
