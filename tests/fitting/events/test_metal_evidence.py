"""Metal or dielectric by the evidence of images and neighbours."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mi_refgs.fitting.events import metal_evidence as event
from mi_refgs.fitting.image_error import displayed_image
from mi_refgs.fitting.train import Trainer
from mi_refgs.kernels.device import upload_tensor
from mi_refgs.methods.fields import Window
from mi_refgs.methods.method import LIGHT, DataOptions
from mi_refgs.render.display import image_array
from mi_refgs.surfels.attributes import SH_DC, logit, sigmoid
from mi_refgs.surfels.table import Surfels
from tests.helpers import unit, with_pixels
from tests.scenes.highlight import ball, small_method

COUNT = 300
GOLD, RED = np.array([0.9, 0.7, 0.3]), np.array([0.5, 0.1, 0.05])  # albedo, radiance


def sphere(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Raw values of a unit ball, whose upper half is of gold and whose lower one of red plastic."""
    outward = unit(rng.normal(size=(COUNT, 3)))
    turned = [Rotation.align_vectors(normal, [0, 0, 1])[0].as_quat() for normal in outward]
    upper = outward[:, 2:] > 0
    radiance = np.zeros((COUNT, 12))
    radiance[:, :3] = (RED - 0.5) / SH_DC
    return {
        "position": outward,
        "rotation": np.array(turned),
        "scale": np.full((COUNT, 2), np.log(0.12)),
        "opacity": np.full((COUNT, 1), 6.0),
        "radiance_sh": radiance,
        "albedo": np.tile(logit(GOLD), (COUNT, 1)),
        "metallic": logit(upper),
        "roughness": np.full((COUNT, 1), logit(0.2)),
        "indirect_sh": np.zeros((COUNT, 48)),
        "confidence": np.zeros((COUNT, 1)),
    }


@pytest.mark.filterwarnings("ignore:Optimal rotation")
def test_images_decide(tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    """Images of a ball of gold and plastic tell both apart, and the metal's colour; metallic then stays."""
    method = replace(small_method(tmp_path), event={}, data=DataOptions())
    data, said = ball(32, views=12), list[str]()
    trainer = Trainer(method, data, tell=said.append)
    trainer.fit.iteration = 20  # deferred
    light = np.array(trainer.fit.params[LIGHT])
    trainer.fit.params[LIGHT] = upload_tensor(light + rng.normal(size=light.shape))
    raw = sphere(rng)
    trainer.fit.tables[0].replace(Surfels.from_numpy(raw))
    views = []
    for view, frame in [(view, trainer.view(view.camera())) for view in data.views]:
        alpha = image_array(frame.alpha, view.height, view.width)
        views.append(with_pixels(view, image=displayed_image(frame, view, data), alpha=alpha))
    trainer.use(replace(data, views=tuple(views)))
    unknown = {name: 0 * raw[name] for name in ("metallic", "albedo", "radiance_sh")}
    trainer.fit.tables[0].replace(Surfels.from_numpy(raw | unknown))

    monkeypatch.setattr(event, "STEPS", 4)  # COUNT surfels are few
    evidence = event.MetalEvidence(Window(0, 30, 10))
    assert evidence.due(trainer)
    evidence.apply(trainer)
    found = trainer.surfels.to_numpy()
    clear = abs(raw["position"][:, 2]) > 0.2
    metal = sigmoid(found["metallic"][:, 0])
    assert {*np.round(metal, 6)} == {event.DIELECTRIC, event.METAL}
    right = (metal > 0.5) == (raw["position"][:, 2] > 0)
    assert right[clear].mean() > 0.95 and trainer.fit.optimiser.factors["metallic"] == 0
    sure = sigmoid(found["confidence"][:, 0])
    assert sure[right].mean() > 0.5 and sure[~right].mean() < sure[right].mean() - 0.1
    assert np.median(abs(sigmoid(found["albedo"]) - GOLD)[clear & (metal > 0.5)]) < 0.05
    assert f"metal: {np.mean(metal > 0.5):.0%} of the surfels" in said[-1]
    monkeypatch.setattr(type(trainer.shading().model), "light", "none")  # what reflects nothing tells nothing
    assert not evidence.due(trainer)


def test_each_material_is_fitted(rng: np.random.Generator) -> None:
    """A dielectric has one colour in all views; a metal reflects; both are found without error."""
    x, albedo, radiance = rng.random((50, 1, 3)), rng.uniform(0.1, 0.9, (4, 3)), rng.random((4, 3))
    y = np.concatenate([radiance + 0 * x, (albedo - event.DIELECTRIC_F0) / 0.96 * x], axis=1)
    sums = [np.ones_like(y), y, y * y, x * y, x * x + 0 * y]
    flat = np.concatenate([50 * np.ones((1, 8)), *(part.sum(axis=0).T for part in sums)])
    errors, tint, colour, pixels = event.fitted(flat)
    np.testing.assert_allclose([errors[0, :4], errors[1, 4:]], 0, atol=1e-9)
    assert (errors[1, :4] > 0.1).all() and (errors[0, 4:] > 0.01).all() and (pixels == 50).all()
    np.testing.assert_allclose(tint[4:], albedo)
    np.testing.assert_allclose(colour[:4], radiance)


def test_neighbours_of_the_same_colour_decide(rng: np.random.Generator) -> None:
    """On a plane of two colours, single errors and surfels that no image shows follow those around; without
    images, the gain is 0; where both materials explain them equally, metallic as it was learnt decides."""
    raw = sphere(rng) | {"position": np.pad(rng.random((COUNT, 2)), ((0, 0), (0, 1)))}
    raw["rotation"] = np.tile([0.0, 0, 0, 1], (COUNT, 1))
    left = raw["position"][:, 0] < 0.5
    colour = np.where(left[:, None], GOLD, RED)
    pixels = 10.0 * (rng.random(COUNT) > 0.2)
    sign = np.where(left, 1, -1) * np.where(rng.random(COUNT) < 0.1, -1, 1)
    errors = pixels * np.exp([0.2 * sign, -0.2 * sign])
    surfels = Surfels.from_numpy(raw)
    gain = event.preferred(surfels, errors, pixels, colour)
    np.testing.assert_array_equal(gain > 0, left)
    assert (event.preferred(surfels, 0 * errors, 0 * pixels, colour) == 0).all()
    learnt = Surfels.from_numpy(raw | {"metallic": logit(np.where(left, 0.9, 0.2))})
    gain = event.preferred(learnt, np.ones_like(errors), pixels, colour)
    np.testing.assert_allclose(gain, event.FITTED * np.where(left, 0.4, -0.3), rtol=1e-3)
