"""A loop of one's own: `mi.render`, Adam over `mi.traverse`, rows that split and move."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

import mi_refgs
from tests.helpers import unit


def scene_of(surfels: mi_refgs.Surfels, light: Any) -> Any:
    pose = mi.ScalarTransform4f().look_at([4, 0, 1], [0, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": 24, "height": 24, "pixel_format": "rgba"}
    camera = {"type": "perspective", "fov": 34, "to_world": pose, "film": film}
    integrator = {"type": "refgs", **surfels.raw, "light": light}
    return mi.load_dict({"type": "scene", "refgs": integrator, "c": camera})


def test_a_loop_over_the_parameters_of_a_scene(rng: np.random.Generator) -> None:
    """The score is the length of the position's gradient; moments follow children and moved rows."""
    points = unit(rng.normal(size=(150, 3)))
    true = mi_refgs.from_points(points, points, 0.5 + 0.4 * points, rng=rng, opacity=0.95, metallic=0.1)
    light = mi_refgs.EnvironmentLight.constant(1, height=8).raw
    goal = mi.render(scene_of(true, light), spp=1)
    start = mi_refgs.from_points(points[:100], points[:100], rng=rng, opacity=0.9, metallic=0.1)
    scene = scene_of(start, light)
    params = mi.traverse(scene)
    own = mi_refgs.learning_rates(start.raw, extent=1.0, iterations=16)
    rates = {f"refgs.{name}": rate for name, rate in own.items()} | {"refgs.light": 0.01}
    adam = mi_refgs.Adam(params, rates)
    table = mi_refgs.ParameterTable(params, adam, "refgs.")
    losses = []
    for step in range(16):
        params.update()
        image = mi.render(scene, params, spp=1)
        planes, true_planes = (mi_refgs.image_planes(x) for x in (image, goal))
        loss = mi_refgs.l1(planes, true_planes) + mi_refgs.d_ssim(planes, true_planes, 24, 24)
        dr.backward(loss)
        moved = dr.grad(params["refgs.position"]).numpy()
        table.observe(mi.Float(np.linalg.norm(moved, axis=1)))
        adam.step(step, loss)
        losses.append(float(loss.array[0]))
        if step == 7:
            table.apply(mi_refgs.densify_and_prune(table.surfels, table.error_sum, most=130))
            table.clear()
    state = adam.state_dict()
    assert table.surfels.count == 125 == dr.width(table.error_sum) == len(state["refgs.opacity/first"])
    assert adam.report().count == 0 and losses[-1] < 0.7 * losses[0], losses
