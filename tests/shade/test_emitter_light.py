"""The scene's environment as a light: turned and mirrored as Mitsuba shows it."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.plugins.light import emitter_light, own_light, rotated
from tests.helpers import AXES, emitted, refused, unit, vector
from tests.scenes.integrator import sky


def T(matrix: object = None) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f() if matrix is None else mi.ScalarTransform4f(matrix)


TURNS = {
    "as it is": lambda: T(),
    "mirrored in x": lambda: T().scale([-1, 1, 1]),
    "mirrored in z and turned": lambda: T().rotate([0.6, 0, 0.8], 40).scale([1, 1, -1]),
    "moved": lambda: T().translate([3, 1, 2]),
}


def emitter(to_world: object) -> mi.Emitter:
    return mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(sky()), "to_world": to_world})


@pytest.mark.parametrize("turn", TURNS)
def test_radiance_is_that_of_mitsuba(turn: str, rng: np.random.Generator) -> None:
    """Along the axes and between them, of the scene's own light and of the integrator's copy."""
    directions, made = unit(np.vstack([AXES, rng.normal(size=(50, 3))])), emitter(TURNS[turn]())
    world, truth = vector(directions), emitted(made, directions).T
    np.testing.assert_allclose(emitter_light(made).radiance(world).numpy(), truth, rtol=1e-3)
    own, to_world = own_light(made)
    np.testing.assert_allclose(rotated(own.prefilter(), to_world).radiance(world).numpy(), truth, rtol=1e-3)


@pytest.mark.parametrize("factors", [[2, 2, 2], [1, 2, 1], [-1, 1, 1.001]])
def test_scale_and_shear_are_refused(factors: list[float]) -> None:
    refused(lambda: emitter_light(emitter(T().scale(factors))), "remove scale and shear")
    sheared = np.eye(4)
    sheared[0, 1] = 0.1
    refused(lambda: own_light(emitter(T(sheared))), "remove scale and shear")
