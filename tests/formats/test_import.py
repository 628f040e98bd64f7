"""PLY files of other programs: read, rendered by their own formulas, refused, imported and exported."""

import gzip
import json
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mi_refgs
from mi_refgs.cli import main
from mi_refgs.constants import GAUSSIAN_LOW_PASS
from mi_refgs.data.poses import MITSUBA_FROM_OPENGL
from mi_refgs.formats.cameras import read_cameras
from mi_refgs.formats.splat_import import read_splats
from mi_refgs.reference import splat as oracle
from mi_refgs.reference.camera import PinholeCamera
from mi_refgs.reference.models import harmonics
from mi_refgs.render.display import displayed, image_array
from mi_refgs.shade.points import ShadingPoints
from mi_refgs.shade.shading import Shading, shade
from mi_refgs.splat import Camera
from tests.helpers import read_exr, refused, unit, with_grad
from tests.scenes.layouts import ply_bytes

SIZE, FOCAL, COUNT = 48, 60.0, 40
BACKGROUND = np.array([0.2, 0.5, 0.9])
LAYOUTS = {"3DGS of degree 0": (3, 0), "3DGS of degree 3": (3, 3), "2DGS": (2, 2)}
"""Number of scales of a splat, and the SH degree of its colour."""


def their_columns(sizes: int, degree: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Columns of the released code: f_rest channel after channel, zero normals; colours beyond 0 … 1."""
    position = rng.uniform(-0.5, 0.5, (COUNT, 3))
    position[:, 2] = np.linspace(-0.6, 0.6, COUNT)  # far enough apart for every rule of sorting
    turn = np.concatenate([np.ones((COUNT, 1)), 0.25 * rng.normal(size=(COUNT, 3))], axis=1)
    columns = dict(zip("xyz", position.T, strict=True))
    columns |= {name: np.zeros(COUNT) for name in ("nx", "ny", "nz")}
    for name, values in (
        ("f_dc", 3 * rng.normal(size=(COUNT, 3))),
        ("f_rest", 0.3 * rng.normal(size=(COUNT, 3 * (degree + 1) ** 2 - 3))),
        ("scale", np.log(rng.uniform(0.1, 0.25, (COUNT, sizes)))),
        ("rot", turn),
    ):
        columns |= {f"{name}_{i}": column for i, column in enumerate(values.T)}
    columns["opacity"] = rng.normal(size=COUNT)
    return {name: column.astype(np.float32) for name, column in columns.items()}


def pinhole() -> PinholeCamera:
    """A camera 3 units below the splats that looks up at them."""
    pose = np.eye(4)
    pose[:3, 3] = [0.1, -0.05, -3]
    return PinholeCamera(SIZE, SIZE, -FOCAL, -FOCAL, SIZE / 2, SIZE / 2, pose, 0.01)


def their_image(columns: dict[str, np.ndarray], camera: PinholeCamera) -> tuple[np.ndarray, np.ndarray]:
    """Encoded colours, composited as they are, in float64; and where a cut may fall either way."""

    def table(*starts: str) -> np.ndarray:
        found = [columns[name] for start in starts for name in columns if name.startswith(start)]
        return np.stack(found, axis=1).astype(np.float64)

    raw = {name: table(name) for name in ("scale", "opacity")}
    raw |= {"position": table("x", "y", "z"), "rotation": table("rot_1", "rot_2", "rot_3", "rot_0")}
    towards = unit(raw["position"] - camera.to_world[:3, 3])
    dc = table("f_dc")
    rest = table("f_rest").reshape(COUNT, 3, -1) if "f_rest_0" in columns else np.zeros((COUNT, 3, 0))
    sh = np.concatenate([dc[:, :, None], rest], axis=2).transpose(0, 2, 1).reshape(COUNT, -1)
    maps = oracle.splat(raw, np.maximum(0, harmonics(sh, towards) + 0.5), camera)
    return maps.features + (1 - maps.alpha[..., None]) * BACKGROUND, maps.band


@pytest.fixture
def theirs(tmp_path: Path, rng: np.random.Generator) -> Path:
    path = tmp_path / "theirs.ply"
    path.write_bytes(ply_bytes(their_columns(3, 0, rng)))
    return path


@pytest.mark.parametrize("name", LAYOUTS)
def test_splat_file_matches_float64_reference(name: str, tmp_path: Path, rng: np.random.Generator) -> None:
    columns, path, c = their_columns(*LAYOUTS[name], rng), tmp_path / "theirs.ply", pinhole()
    path.write_bytes(ply_bytes(columns))
    goal, band = their_image(columns, c)
    scene = read_splats(path)
    assert scene.surfels.sh_degree() == LAYOUTS[name][1]
    frame = scene.renderer()(Camera.from_pose(SIZE, SIZE, c.fx, c.fy, c.cx, c.cy, c.to_world, c.near))
    shown = image_array(displayed(frame, BACKGROUND, False), SIZE, SIZE)
    assert goal.max() > 1 and goal.std() > 0.1 and band.mean() < 0.2
    assert np.abs(shown - goal)[~band].max() < 2e-4
    assert GAUSSIAN_LOW_PASS == 0.3  # theirs


def test_import_splats_equals_the_command(theirs: Path, tmp_path: Path) -> None:
    """In memory, saved, and by the command: the same image bit for bit; linear colours render differently."""
    made = mi_refgs.import_splats(str(theirs))
    assert made.trained.shading == Shading("pixel", "displayed") and made.folder is None
    assert made.method.name == "theirs" and len(made.cameras()) == 4
    picture = made.render(1, size=32)
    assert picture[..., :3].max() > 0.1
    np.testing.assert_array_equal(made.save(tmp_path / "saved").render(1, size=32), picture)
    run = tmp_path / "run"
    assert main(["import", str(theirs), "-o", str(run)]) == 0
    np.testing.assert_array_equal(mi_refgs.load(run).render(1, size=32), picture)
    refused(["import", theirs, "-o", run], "a run already")
    other = mi_refgs.import_splats(theirs, linear=True)
    assert other.trained.shading == Shading("surfel", "radiance")
    assert np.abs(other.render(1, size=32) - picture).max() > 0.05
    refused(lambda: mi_refgs.import_splats(tmp_path / "no.ply"), "missing")


@pytest.mark.parametrize("name", LAYOUTS)
def test_imported_gaussians_are_exported_as_is(name: str, tmp_path: Path, rng: np.random.Generator) -> None:
    """Encoded colours are not fitted anew; Gaussians come back bit for bit."""
    theirs, again = tmp_path / "theirs.ply", tmp_path / "again.ply"
    theirs.write_bytes(ply_bytes(their_columns(*LAYOUTS[name], rng)))
    mi_refgs.import_splats(theirs).export("3dgs-ply", again)
    before, after = (read_splats(path).surfels.to_numpy() for path in (theirs, again))
    columns = before["radiance_sh"].shape[1]
    np.testing.assert_array_equal(after["radiance_sh"][:, :columns], before["radiance_sh"])
    assert not after["radiance_sh"][:, columns:].any() and after["scale"].shape[1] == 3
    if before["scale"].shape[1] == 3:
        np.testing.assert_array_equal(after["position"], before["position"])


def test_displayed_model_inverts_the_srgb_encoding() -> None:
    """Values below and above the straight part, and the derivative, against differences of the formula."""
    encoded = np.array([0.0, 0.02, 0.04, 0.05, 0.5, 1.0, 1.7])
    formula = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    plane = with_grad(mi.Float(encoded.astype(np.float32)))
    points = ShadingPoints(mi.Vector3f(0, 0, 1), mi.Vector3f(0, 0, 1), radiance=mi.Color3f(plane))
    out = shade(points, None, Shading("pixel", "displayed")).total()
    np.testing.assert_allclose(np.array(dr.detach(out.x)), formula, rtol=1e-5, atol=1e-7)
    dr.forward(plane)
    slope = np.where(encoded <= 0.04045, 1 / 12.92, 2.4 / 1.055 * ((encoded + 0.055) / 1.055) ** 1.4)
    np.testing.assert_allclose(np.array(dr.grad(out.x)), slope, rtol=1e-4)


HEADER = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty uchar "
FACES = b"element face 0\nproperty list uchar int vertex_indices\n"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ((b"float rot_3\n", b"float other\n"), "rot_3: the property is missing"),
        ((b"float f_", b"float a_"), "f_dc_0: the property is missing"),
        ((b"float f_rest_44\n", b"float nothing\n"), "f_rest_*: 44 properties"),
        ((b"float nx\n", b"float metallic\n"), "metallic: materials, which require their light"),
        ((b"float nx\n", b"float f_anchor_feat_0\n"), "f_anchor_feat_0: anchors of Scaffold-GS"),
        ((b"vertex 40", b"vertex 0"), "there are none"),
        (HEADER + b"red\nend_header\n0\n", "vertex: points with colours, no Gaussians"),
        (HEADER + b"x\n" + FACES + b"end_header\n0\n", "vertex: a mesh, no Gaussians"),
        (b"<!DOCTYPE html>\n", "not a PLY file but a web page"),
        (b"PK\x03\x04" + bytes(26) + b"archive/data.pkl", "not a PLY file but PyTorch's or a zip file"),
        (gzip.compress(b"hello", mtime=0), "a compressed file, but not SPZ; decompress it first"),
        (b"hello\n", "not a PLY file; give the PLY file of 3DGS or 2DGS"),
        (None, "unusable are 40 of 40 rows: 0 with NaN or infinity, 40 with zero rotation"),
    ],
)
def test_other_files_are_refused(
    content: bytes | tuple[bytes, bytes] | None, message: str, tmp_path: Path, rng: np.random.Generator
) -> None:
    """Files, replacements in the header of a good file, and its header with zeros."""
    path, whole = tmp_path / "file.ply", ply_bytes(their_columns(3, 3, rng))
    header, end, body = whole.partition(b"end_header\n")
    if content is None:
        content = header + end + bytes(len(body))
    path.write_bytes(content if isinstance(content, bytes) else header.replace(*content) + end + body)
    refused(["import", path, "-o", tmp_path / "run"], path, message)
    assert not (tmp_path / "run").exists()


def transforms() -> dict[str, object]:
    frame = {"transform_matrix": (pinhole().to_world @ MITSUBA_FROM_OPENGL).tolist()}
    return {"w": 64, "h": 48, "camera_angle_x": 0.8, "frames": [frame, {**frame, "w": 32, "fl_x": 40.0}]}


def test_transforms_file_defines_the_cameras_of_an_import(theirs: Path, tmp_path: Path) -> None:
    file, run = tmp_path / "transforms.json", tmp_path / "run"
    file.write_text(json.dumps(transforms()))
    assert main(["import", str(theirs), "-o", str(run), "--camera", str(file)]) == 0
    first, second = (Camera.from_sensor(sensor) for sensor in mi.load_file(str(run / "scene.xml")).sensors())
    assert (first.width, first.height, second.width) == (64, 48, 32)
    np.testing.assert_allclose(first.pose(), pinhole().to_world, atol=1e-6)
    np.testing.assert_allclose([-first.fx[0], -second.fx[0]], [32 / np.tan(0.4), 40], rtol=1e-4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": []}, "frames: empty"),
        ({"w": None}, "w: 0 × 48 is no size of an image"),
        ({"fl_x": -3}, "fl_x: -3 is not a positive number"),
        ({"cx": "0"}, "cx: '0' is not a number"),
        ({"k1": 0.1}, "k1: no pinhole"),
        ({"camera_model": "OPENCV_FISHEYE"}, "camera_model: no pinhole"),
        ({"camera_model": "EQUIRECTANGULAR"}, "camera_model: the lens 'EQUIRECTANGULAR' is not"),
        ({"frames": [{}]}, "frames[0].transform_matrix: missing or not 4 × 4"),
        ({"frames": [{"transform_matrix": (2 * np.eye(4)).tolist()}]}, "not a rotation and a translation"),
    ],
)
def test_bad_transforms_file_is_refused(change: dict[str, object], message: str, tmp_path: Path) -> None:
    file = tmp_path / "transforms.json"
    file.write_text(json.dumps({**transforms(), **change}))
    refused(lambda: read_cameras(file), file, message)


@pytest.mark.parametrize("scale", [1e-4, 1e5])
def test_cameras_of_a_file_do_not_clip_scenes_of_any_size(
    scale: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A black ball in white light is not cut off; the scene of Mitsuba's has no sensor."""
    scene, file, out = tmp_path / "scene.xml", tmp_path / "camera.json", tmp_path / "out.exr"
    scene.write_text(
        '<scene version="3.0.0"><integrator type="path"/><emitter type="constant"/>'
        f'<shape type="sphere"><float name="radius" value="{scale}"/>'
        '<bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf></shape></scene>'
    )
    pose = np.array(mi.ScalarTransform4f().look_at([4 * scale, 0, 0], [0, 0, 0], [0, 0, 1]).matrix)
    frame = {"transform_matrix": (pose @ MITSUBA_FROM_OPENGL).tolist()}
    file.write_text(json.dumps({"w": 16, "h": 12, "camera_angle_x": 0.8, "frames": [frame]}))
    command = ["render", str(scene), "-o", str(out)]
    refused(command, "sensor: the scene has none; add one, or give a file with --camera")
    refused([*command, "--camera", file, "--sensor", "2"], f"{file}: --sensor: 2: the file has 1 frame; give")
    assert main([*command, "--camera", str(file)]) == 0
    seen = read_exr(out)["R"]
    assert seen.shape == (12, 16) and seen[5:7, 7:9].max() == 0 and seen[0, 0] == pytest.approx(1)
    file.write_text(json.dumps({"w": 16, "h": 12, "fl_x": 20, "fl_y": 25, "frames": [frame]}))
    assert main([*command, "--camera", str(file)]) == 0
    assert "Mitsuba's pixels are square: 20 × 12 of them for 16 × 12" in capsys.readouterr().err
