"""Images of the `refgs` plugin: AOVs, films, crop windows, samples, sensors."""

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.helpers import refused
from tests.scenes import integrator
from tests.scenes.integrator import HEIGHT, WIDTH, check_derivatives, image, plane_mesh, scene, sensor
from tests.scenes.splats import discs

EVERY_AOV = "al:albedo,m:metallic,r:roughness,n:normal,dd.y:depth,a:alpha,v:visibility"
EVERY_AOV += ",di:diffuse,sp:specular,ind:indirect"


def test_aovs_follow_mitsubas_names(tmp_path: Path) -> None:
    of = scene(sensor(film={"pixel_format": "rgba"}), aovs=EVERY_AOV, mesh=plane_mesh(tmp_path))
    names = ["al.R", "al.G", "al.B", "m.Y", "r.Y", "n.X", "n.Y", "n.Z", "dd.y.T", "a.Y", "v.Y"]
    names += [f"{term}.{c}" for term in ("di", "sp", "ind") for c in "RGB"]
    assert of.integrator().aov_names() == names
    result = image(of)
    assert result.shape == (HEIGHT, WIDTH, 4 + len(names))
    rgb, alpha = result[..., :3], result[..., 3]
    aov = dict(zip(names, np.moveaxis(result[..., 4:], 2, 0), strict=True))
    np.testing.assert_array_equal(aov["a.Y"], alpha)
    for i, c in enumerate("RGB"):
        np.testing.assert_allclose(aov[f"di.{c}"] + aov[f"sp.{c}"] + aov[f"ind.{c}"], rgb[..., i], atol=1e-6)
    seen = alpha > 0.01
    assert seen.any() and not seen.all()
    np.testing.assert_allclose(sum(aov[f"n.{c}"] ** 2 for c in "XYZ")[seen], 1, atol=1e-5)
    assert 0 < aov["v.Y"][seen].mean() < 1 and aov["ind.R"].max() > 0
    assert np.all((aov["r.Y"][seen] > 0) & (aov["r.Y"][seen] < 1))
    assert all(np.all(values[alpha == 0] == 0) for values in aov.values())
    # The film contains the same image, in layers.
    layers = dict(of.sensors()[0].film().bitmap().split())
    assert set(layers) == {"<root>", "al", "m", "r", "n", "dd.y", "a", "v", "di", "sp", "ind"}
    normal = np.stack([aov[f"n.{c}"] for c in "XYZ"], -1)
    assert np.allclose(np.array(layers["n"]), normal, atol=1e-3)  # float16 film


def test_a_batch_is_its_sensors_side_by_side() -> None:
    """Images, and derivatives in both modes, also by a sensor's own field of view. Mitsuba makes one object
    of the equal ones."""
    eyes = ([3, 1, 2], [-1, 2.5, 2], [0, -2, 1.5], [3, 1, 2])
    poses = [mi.ScalarTransform4f().look_at(eye, [0, 0, 0], [0, 0, 1]) for eye in eyes]
    whole = sensor(film={"width": 4 * WIDTH})
    lenses = {f"s{i}": {"type": "perspective", "fov": 45, "to_world": pose} for i, pose in enumerate(poses)}
    batch = {"type": "batch", "film": whole["film"], "sampler": whole["sampler"], **lenses}
    alone = [scene(sensor(to_world=pose)) for pose in poses]
    together = scene(batch)
    np.testing.assert_array_equal(image(together), np.concatenate([image(one) for one in alone], axis=1))
    check_derivatives(together, "integrator.albedo", spp=4)
    fresh = scene(batch)  # whose film was not used before
    params = mi.traverse(fresh)
    dr.enable_grad(params["integrator.albedo"])
    dr.set_grad(params["integrator.albedo"], 1)
    assert dr.any(fresh.integrator().render_forward(fresh, params, fresh.sensors()[0], 0, 4) != 0, axis=None)
    slopes = []
    for of, key in ((alone[1], "sensor.x_fov"), (together, "sensor.s1.x_fov")):
        params = mi.traverse(of)
        dr.enable_grad(params[key])
        dr.backward(dr.sum(mi.render(of, params), axis=None))
        slopes.append(dr.grad(params[key]).numpy())
    np.testing.assert_allclose(slopes[0], slopes[1], rtol=1e-5)
    assert slopes[0] != 0
    cropped = sensor(film={"width": 4 * WIDTH, "crop_width": WIDTH, "crop_height": 6})["film"]
    refused(lambda: image(scene(batch | {"film": cropped})), "a crop of a `batch`", "one by one")


def test_a_mirrored_sensor_shows_the_mirror_image() -> None:
    """Normals that vary over a surfel bend the same way."""
    raw, turn = integrator.raw_channels(), mi.ScalarTransform4f
    raw["curvature"] = np.tile(np.array([2, 0, 2], np.float32), (len(raw["position"]), 1))
    pose = turn().look_at([3, 1, 2], [0, 0, 0], [0, 0, 1])
    poses = (pose, pose @ turn().scale([-1, 1, 1]))
    straight, mirrored = (image(scene(sensor(to_world=to_world), raw=raw)) for to_world in poses)
    np.testing.assert_allclose(mirrored[:, ::-1], straight, atol=1e-3)


def test_depth_is_that_of_mitsuba() -> None:
    """One large opaque disc against a rectangle in the same plane under Mitsuba's own `aov` integrator."""
    raw = discs(scale=np.log([[50.0, 50.0]]), opacity=[[9.0]], radiance_sh=[[1.0, 1.0, 1.0]])
    view = sensor(near_clip=0.5, film={"width": 5, "height": 5})
    channels = {name: mi.TensorXf(np.array(values, np.float32)) for name, values in raw.items()}
    ours = {"type": "refgs", "aovs": "d:depth", **channels}
    plate = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(100)}
    stock = {"type": "aov", "aovs": "d:depth"}
    stock = mi.load_dict({"type": "scene", "integrator": stock, "sensor": view, "plate": plate})
    reference = image(stock, spp=4096)[..., 0]
    depth = image(mi.load_dict({"type": "scene", "integrator": ours, "sensor": view}), spp=64)[..., 3]
    np.testing.assert_allclose(depth, reference, rtol=1e-2)  # the noise of the reference's jitter


@pytest.mark.parametrize(
    ("kind", "options"),
    [("thinlens", {"fov": 45, "aperture_radius": 0.1, "focus_distance": 3.0}), ("orthographic", {})],
)
def test_other_sensors_are_refused(kind: str, options: dict) -> None:
    camera = {name: value for name, value in sensor().items() if name != "fov"} | options
    refused(lambda: image(scene(camera | {"type": kind})), "use a `perspective` sensor")
