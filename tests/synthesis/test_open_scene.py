"""Path-traced data sets of an object in a room: images of all, maps of the object, COLMAP's files."""

import shutil
from pathlib import Path
from typing import Any
from unittest.mock import Mock
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from scipy.ndimage import binary_erosion

from mi_refgs.cli import main
from mi_refgs.data.region import Region, read_region, write_region
from mi_refgs.io.exr import write_exr
from mi_refgs.synthesis.make_dataset import REGION_MARGIN, make_dataset
from mi_refgs.synthesis.options import DatasetOptions
from mi_refgs.synthesis.pathtrace import object_of
from tests.helpers import emitted, read_loaded, refused, unit

CENTRE, RADIUS = np.array([0.3, -0.2, 0.5]), 0.5
WALL = 4.0
WIDTH, HEIGHT = 18, 32

ROOM = f"""<scene version="3.0.0">
    <emitter type="constant"><rgb name="radiance" value="0.4"/></emitter>
    <bsdf type="diffuse" id="grey"><rgb name="reflectance" value="0.5"/></bsdf>
    <shape type="sphere" id="ball">
        <point name="center" value="{CENTRE[0]}, {CENTRE[1]}, {CENTRE[2]}"/>
        <float name="radius" value="{RADIUS}"/>
        <bsdf type="principled">
            <rgb name="base_color" value="0.8, 0.3, 0.1"/>
            <float name="roughness" value="0.3"/><float name="metallic" value="1"/>
        </bsdf>
    </shape>
    <shape type="rectangle" id="table">
        <transform name="to_world"><scale value="{WALL}"/></transform><ref id="grey"/>
    </shape>
    <shape type="cube" id="wall">
        <transform name="to_world"><scale value="0.1, {WALL}, {WALL}"/><translate x="{WALL}"/></transform>
        <ref id="grey"/>
    </shape>
    <shape type="sphere" id="lamp">
        <point name="center" value="0, 0, 5"/><emitter type="area"><rgb name="radiance" value="4"/></emitter>
    </shape>
</scene>"""
DOME = '<shape type="sphere" id="dome"><float name="radius" value="40"/></shape>'
OPTIONS: dict[str, Any] = {"views": 6, "test_views": 2, "size": (WIDTH, HEIGHT), "spp": 16, "progress": False}
OPTIONS |= {"objects": ["ball"], "elevation": (20.0, 60.0), "distance": (2.0, 2.6), "environment_height": 32}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ball on a table before a wall."""
    folder = tmp_path_factory.mktemp("open")
    (folder / "room.xml").write_text(ROOM)
    return make_dataset(folder / "room.xml", folder / "out", **OPTIONS)


def test_open_scene_images_show_all_and_maps_the_object(made: Path) -> None:
    for view in read_loaded(made, "train").views:
        assert (view.width, view.height) == (WIDTH, HEIGHT)
        assert view.alpha is None and view.image.min() > 0
        assert view.normal is not None and view.depth is not None
        eye = view.to_world[:3, 3]
        assert 2.0 <= np.linalg.norm(eye - CENTRE) <= 2.6
        rays = unit(np.array(view.camera().rays()).T)
        toward = CENTRE - eye
        across = np.linalg.norm(toward - (rays @ toward)[:, None] * rays, axis=1)
        hit = view.depth.ravel() > 0
        np.testing.assert_array_equal(hit, across < RADIUS)  # the ball's pixels, and nobody else's
        assert 0.05 < hit.mean() < 0.7
        np.testing.assert_array_equal(np.any(view.normal.reshape(-1, 3) != 0, axis=1), hit)
        for name, value in {"albedo": (0.8, 0.3, 0.1), "roughness": (0.3,), "metallic": (1.0,)}.items():
            planes = view.materials[name].reshape(WIDTH * HEIGHT, -1)
            np.testing.assert_allclose(planes[hit, :-1], np.tile(value, (hit.sum(), 1)), atol=1e-6)
            np.testing.assert_array_equal(planes[:, -1], hit)


def test_open_scene_surface_and_region_are_those_of_the_object(made: Path) -> None:
    region = read_region(made)
    assert region is not None
    np.testing.assert_allclose(region.centre, CENTRE, atol=1e-6)
    np.testing.assert_allclose(region.radius, REGION_MARGIN * RADIUS, rtol=1e-3)
    vertices = np.asarray(trimesh.load_mesh(made / "surface.ply", process=False).vertices)
    np.testing.assert_allclose(np.linalg.norm(vertices - CENTRE, axis=1), RADIUS, rtol=1e-4)


def test_environment_of_open_scene_is_the_room_without_the_object(made: Path) -> None:
    """Lamp, distant light and wall in their directions from the ball's centre, which the ball would hide."""
    light = mi.load_dict({"type": "envmap", "filename": str(read_loaded(made, "test").environment)})
    directions = np.array([[0, 0, 5], [CENTRE[0], CENTRE[1] - 9, 2], [WALL - 0.1, CENTRE[1], 1]]) - CENTRE
    lamp, distant, wall = emitted(light, directions)[:, 0]
    np.testing.assert_allclose((lamp, distant), (4, 0.4), rtol=1e-3)
    assert 0.1 < wall < 0.35  # half of what it receives: up to 0.4, and of the lamp


def test_relit_object_of_open_scene_is_alone(made: Path, tmp_path: Path) -> None:
    """Under light of radiance 2 from everywhere: no lamp, no table, and its outline as alpha."""
    write_exr(tmp_path / "even.exr", np.full((8, 16, 3), 2, np.float32))
    out, drawn = shutil.copytree(made, tmp_path / "out"), Region((0.0, 0.0, 0.0), 2.0)
    write_region(out, drawn)  # by a user: another light leaves it
    make_dataset(made.parent / "room.xml", out, relight=tmp_path / "even.exr", **OPTIONS)
    assert read_region(out) == drawn
    relit = read_loaded(out / "relight" / "even", "test", images="exr", background="black")
    for view, room in zip(relit.views, read_loaded(out, "test").views, strict=True):
        assert view.alpha is not None and room.depth is not None
        np.testing.assert_array_equal(view.to_world, room.to_world)
        masks = (room.depth > 0, room.depth == 0)
        inside, outside = (binary_erosion(mask, np.ones((3, 3)), border_value=1) for mask in masks)
        assert inside.any() and (view.alpha[inside] == 1).all() and not view.alpha[outside].any()
        assert not view.image[outside].any()
        np.testing.assert_allclose(view.image[inside].mean(axis=0), (1.6, 0.6, 0.2), rtol=0.05)


def test_cameras_stay_within_their_azimuths(made: Path, tmp_path: Path) -> None:
    """A photographer before a wall; and the whole range is all around."""
    tiny = {**OPTIONS, "views": 12, "size": 2, "spp": 1}
    for low, high in ((150.0, 230.0), (-180.0, 180.0)):
        out = make_dataset(made.parent / "room.xml", tmp_path / f"{high:g}", azimuth=(low, high), **tiny)
        eyes = np.stack([view.to_world[:3, 3] - CENTRE for view in read_loaded(out, "train").views])
        azimuth = np.sort(np.degrees(np.arctan2(eyes[:, 1], eyes[:, 0])) % 360)
        around = np.diff([*azimuth, azimuth[0] + 360]).max() < 60
        assert around if high == 180 else low < azimuth[0] < low + 15 and high - 15 < azimuth[-1] < high


@pytest.mark.parametrize(("more", "around"), [("", ["table", "wall"]), (DOME, ["dome", "table", "wall"])])
def test_object_is_chosen_among_lamps_and_backdrops(more: str, around: list[str]) -> None:
    scene = mi.load_string(ROOM.replace("</scene>", f"{more}</scene>"), optimize=False)
    chosen, others = object_of(scene.shapes(), DatasetOptions())
    assert [shape.id() for shape in chosen] == ["ball"]
    assert sorted(shape.id() for shape in others) == around


def test_the_choice_of_object_is_said(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = OPTIONS | {"objects": (), "views": 1, "test_views": 1, "spp": 1, "progress": True}
    room = read_loaded(make_dataset(made.parent / "room.xml", tmp_path / "out", **options), "train").views[0]
    assert room.alpha is None and read_region(tmp_path / "out") == read_region(made)
    assert "object is ball; around it: table, wall; lamps do not count; `--object" in capsys.readouterr().err
    lit = ElementTree.fromstring(ROOM)
    for shape in [shape for shape in lit.iter("shape") if shape.get("id") in ("table", "wall")]:
        lit.remove(shape)
    (tmp_path / "lit.xml").write_bytes(ElementTree.tostring(lit))
    alone = read_loaded(make_dataset(tmp_path / "lit.xml", tmp_path / "lit", **options), "train").views[0]
    assert alone.alpha is not None and 0.05 < alone.alpha.mean() < 0.7
    assert "object is ball; around it: nothing" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"objects": ["vase"]}, "--object: no shape has the id 'vase'; give one of ball, lamp, table, wall"),
        ({"distance": (0.55, 2.0)}, "inside of the region"),
        ({"vews": 3}, "make_dataset: vews: unknown option; use some of views"),
    ],
)
def test_refusals(made: Path, tmp_path: Path, options: dict, words: str) -> None:
    refused(lambda: make_dataset(made.parent / "room.xml", tmp_path / "out", **OPTIONS | options), words)
    assert not (tmp_path / "out").exists()


def test_size_option(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make = Mock(return_value=tmp_path)
    monkeypatch.setattr("mi_refgs.synthesis.make_dataset.make_dataset", make)
    for size in ("10x6", "12"):
        assert main(["dataset", "room.xml", "-o", str(tmp_path), "--size", size]) == 0
    assert [call.kwargs["size"] for call in make.call_args_list] == [(10, 6), 12]
