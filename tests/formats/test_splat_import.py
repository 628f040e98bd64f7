"""Splat files as other programs write them: what is left out, replaced or refused, with the right values."""

import gzip
import importlib.util
import json
from pathlib import Path
from typing import Any

import gaussforge
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.formats.cameras import read_cameras
from mi_refgs.formats.splat_import import read_splats
from mi_refgs.io.images import linear_from_srgb
from mi_refgs.reference.models import harmonics
from mi_refgs.shade.brdf import split_sum
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.splat import Camera
from mi_refgs.surfels.attributes import SH_DC, logit, sigmoid
from tests.helpers import refused
from tests.scenes.layouts import ply_bytes
from tests.scenes.splat_file import COUNT, ball_columns

LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1234\n"
SIZE, FILTER = np.log(0.06), 0.05  # of the ball's Gaussians; of Mip-Splatting
FUSED = 0.06**2 + FILTER**2


BALL, ROW = ball_columns(), np.arange(COUNT)
ACTIVATED = {name: np.exp(BALL[name]) for name in ("scale_0", "scale_1", "scale_2")}
ACTIVATED |= {"opacity": sigmoid(BALL["opacity"])}
MIP = {"filter_3D": np.full(COUNT, FILTER)}
COLOURS = {name: np.full(COUNT, 51 * i, "u1") for i, name in enumerate(("red", "green", "blue"))}


def first(name: str, value: float) -> dict[str, np.ndarray]:
    """One column, whose first value is another one."""
    return {name: np.where(ROW > 0, BALL[name], value)}


@pytest.mark.parametrize(
    ("change", "words", "attribute", "expected"),
    [
        (first("opacity", -np.inf), "opacity: 1 infinite", "opacity", -20),
        (first("scale_2", -np.inf), "scale: 1 infinite", "scale", [SIZE, SIZE, -20]),
        (first("x", np.nan), "left out 1 of 300 rows: 1 with NaN or infinity, 0", "position", BALL["x"][1]),
        (first("scale_0", np.inf), "left out 1 of 300 rows: 1 with NaN", "position", BALL["x"][1]),
        (first("rot_0", 0), "left out 1 of 300 rows: 0 with NaN or infinity, 1", "position", BALL["x"][1]),
        (MIP, "antialiasing filter", "scale", 0.5 * np.log(FUSED)),
        (MIP, "", "opacity", logit(sigmoid(4.0) * (0.06**2 / FUSED) ** 1.5)),
        (ACTIVATED, "are activated", "scale", SIZE),
        (ACTIVATED, "", "opacity", 4),
        # The last of green: f_rest_{24 + 14}.
        ({f"f_rest_{i}": np.full(COUNT, i) for i in range(72)}, "SH degree 4 is cut to 3", "radiance_sh", 38),
        ({name: BALL[name].astype("f2").view("u2") for name in BALL}, "", "opacity", 4),
        (COLOURS | {f"f_dc_{i}": None for i in range(3)}, "", "radiance_sh", (0.2 - 0.5) / SH_DC),
    ],
)
def test_splats_of_others_are_read(
    change: dict[str, np.ndarray | None],
    words: str,
    attribute: str,
    expected: Any,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    columns = {name: column for name, column in (BALL | change).items() if column is not None}
    columns = {name: x if x.dtype.kind == "u" else x.astype(np.float32) for name, x in columns.items()}
    (tmp_path / "a.ply").write_bytes(ply_bytes(columns))
    raw = read_splats(tmp_path / "a.ply").surfels.to_numpy()
    assert words in capsys.readouterr().err and len(raw["position"]) == COUNT - ("left out" in words)
    entry = {"radiance_sh": -2, "position": 0}.get(attribute, slice(None))
    np.testing.assert_allclose(raw[attribute][0, entry], expected, atol=1e-4)


@pytest.mark.parametrize(
    ("comment", "said"),
    [
        ("SplatRenderMode: default", False),
        ("SplatRenderMode: mip", True),
        ("antialiased 0", False),
        ("antialiased 1", True),
        ("train_flags antialiasing", True),
    ],
)
def test_antialiasing(comment: str, said: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.ply").write_bytes(ply_bytes(BALL).replace(b"by hand", comment.encode()))
    read_splats(tmp_path / "a.ply")
    assert ("antialiasing filter" in capsys.readouterr().err) == said


def pixel(path: Path, light: float | None = None, **given: bool) -> np.ndarray:
    """Radiance (3,) of an opaque surfel at the origin, seen along z."""
    scene = read_splats(path, light=None if light is None else EnvironmentLight.constant(light), **given)
    pose = np.eye(4)
    pose[2, 3] = -3
    frame = scene.renderer()(Camera.from_pose(8, 8, -8, -8, 4, 4, pose, 0.01))
    return np.array([plane.numpy()[8 * 4 + 4] for plane in frame.radiance]) / frame.alpha.numpy()[8 * 4 + 4]


@pytest.mark.parametrize("scales", [2, 3])
def test_materials_of_others_are_lit(scales: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two scales: Ref-Gaussian, three: 3DGS-DR. Diffuse surfels keep their display colour without light, and
    metals reflect it with their display colour."""
    dc, tint, path = np.array([0.3, -0.2, 0.5]), np.array([1.0, 0.0, -1.0]), tmp_path / "a.ply"
    values = dict.fromkeys("xyz", 0.0) | {f"rot_{i}": float(i == 0) for i in range(4)} | {"opacity": 20.0}
    values |= {f"scale_{i}": 0.0 for i in range(scales)} | {f"f_dc_{i}": x for i, x in enumerate(dc)}
    if scales == 2:
        values |= {f"ori_color_{i}": x for i, x in enumerate(tint)} | {f"ind_dc_{i}": 0.0 for i in range(3)}
        values |= {"metalness": 0.0, "roughness": -20.0, "diffuse_color_0": 3.0}

    def write(metal: float) -> Path:
        content = values | {"refl_strength": metal}
        path.write_bytes(ply_bytes({name: np.array([x], np.float32) for name, x in content.items()}))
        return path

    shown = 0.5 + SH_DC * dc
    np.testing.assert_allclose(pixel(write(-20), 0.0), linear_from_srgb(shown), atol=1e-3)
    np.testing.assert_allclose(pixel(path, 0.0, linear=True), shown, atol=1e-3)
    scale, bias = (float(x[0]) for x in split_sum(mi.Float(1), mi.Float(0)))
    mirrored = linear_from_srgb(sigmoid(tint)) * scale + bias if scales == 2 else np.ones(3)
    np.testing.assert_allclose(pixel(write(20), 0.5), 0.5 * mirrored, atol=3e-3)
    assert "its light" not in capsys.readouterr().err
    np.testing.assert_allclose(pixel(path), mirrored, atol=6e-3)
    said = capsys.readouterr().err
    assert "its light, in another file" in said
    assert ("not read: diffuse_color, metalness;" in said) == (scales == 2)


@pytest.mark.parametrize("kind", ["spz", "sog", "ksplat", "splat", "compressed.ply"])
def test_compressed_splats_are_converted(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    columns = BALL | {f"f_rest_{i}": np.full(COUNT, 0.5, np.float32) for i in range(45)}
    content = gaussforge.GaussForge().convert(ply_bytes(columns), "ply", kind)["data"]
    path = tmp_path / (f"a.{kind}" if "splat" in kind else "a.ply")  # others are known by their first bytes
    path.write_bytes(content)
    raw = read_splats(path).surfels.to_numpy()
    assert not capsys.readouterr().err
    np.testing.assert_allclose(raw["scale"], SIZE, atol=0.04)
    colours = raw["radiance_sh"][:, :3] / np.linalg.norm(raw["radiance_sh"][:, :3], axis=1, keepdims=True)
    turned = [1, -1, -1] if kind == "spz" else [1, 1, 1]  # its +y is up, its +z backward
    np.testing.assert_allclose(raw["position"] * turned, 0.5 * colours, atol=0.02)
    if raw["radiance_sh"].shape[1] > 3:
        seen = np.array([[0.48, 0.6, 0.64], [0.64, -0.48, 0.6]])
        here, there = np.tile(raw["radiance_sh"][0], (2, 1)), np.full((2, 48), 0.5)
        here[:, :3] = there[:, :3] = 0
        np.testing.assert_allclose(harmonics(here, seen * turned), harmonics(there, seen), atol=0.1)
    if kind == "spz":
        flagged = bytearray(gzip.decompress(content))
        flagged[14] |= 1
        path.write_bytes(gzip.compress(flagged))
        read_splats(path)
        assert "antialiasing" in capsys.readouterr().err
        path.write_bytes(content[:60])
        refused(["import", path, "-o", tmp_path / "r"], path, "compressed splats (spz), which cannot be read")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    path.write_bytes(content)
    refused(["import", path, "-o", tmp_path / "run"], f"({kind}); pip install", "`splat-transform a.")


@pytest.mark.parametrize("name", ["a.ply", "a.exr", "a.hdr", "a.png"])
def test_pointers_of_git_lfs_are_named(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(LFS)
    command = ["import", tmp_path / name, "-o", tmp_path / "run"]
    if name != "a.ply":
        command += ["--envmap", tmp_path / name]
    refused(command, name, "a Git LFS pointer in place of the file; fetch it with `git lfs pull`")


def test_cameras_of_3dgs_are_read(tmp_path: Path) -> None:
    turn = [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]  # of a camera that looks along the world's x
    own = {"id": 0, "img_name": "0", "width": 64, "height": 48, "fx": 70.0, "fy": 71.0, "position": [1, 2, 3]}
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps([{**own, "rotation": turn}]))
    (camera,) = read_cameras(path)
    point = camera.to_camera(mi.Point3f(5, 2.4, 3.8))  # 4 ahead, 0.4 to the right, 0.8 down
    x, y = camera.fx * point.x / point.z + camera.cx, camera.fy * point.y / point.z + camera.cy
    np.testing.assert_allclose([x[0], y[0]], [32 + 70 * 0.1, 24 + 71 * 0.2], rtol=1e-5)
    place = camera.pose()[:3, 3]
    for offset, moved in ((0.9 * place, 0.1 * place), (-0.9 * place, place)):  # relative where it is nearer
        np.testing.assert_allclose(read_cameras(path, offset.tolist())[0].pose()[:3, 3], moved, atol=1e-6)
    path.write_text(json.dumps([own]))
    refused(lambda: read_cameras(path), path, "[0]: no camera of 3DGS")
