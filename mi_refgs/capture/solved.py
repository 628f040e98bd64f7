"""What structure from motion found, as arrays: cameras, points, and who saw which."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mi_refgs.capture import colmap

MODELS = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "OPENCV")
"""Lenses that are tried, simple to rich."""
GAIN = 0.01
"""Share by which a richer lens must lower the mean reprojection error to be taken: 50,000 observations would
lower it by 1e-4 if the new parameters fitted nothing but noise."""


@dataclass(frozen=True, eq=False)
class Solved:
    """Placed pictures and triangulated points, in COLMAP's frame or a similar one."""

    names: list[str]  # of the pictures
    rotation: np.ndarray  # (V, 3, 3) camera from world; +x right, +y down, +z forward
    origin: np.ndarray  # (V, 3) world
    half_angle: np.ndarray  # (V,) radians, from the view axis to the nearer pair of the picture's edges
    points: np.ndarray  # (P, 3) world
    length: np.ndarray  # (P,) pictures that saw the point

    @property
    def axis(self) -> np.ndarray:
        """Viewing directions (V, 3), world."""
        return self.rotation[:, 2]

    @classmethod
    def of(cls, model: Any) -> Solved:
        """What a pycolmap.Reconstruction holds; pictures in the order of their names."""
        images = sorted((model.images[i] for i in model.reg_image_ids()), key=lambda image: image.name)
        poses = [image.cam_from_world() for image in images]
        cameras = [model.cameras[image.camera_id] for image in images]
        reach = [min(c.width / c.focal_length_x, c.height / c.focal_length_y) / 2 for c in cameras]
        points = list(model.points3D.values())
        return cls(
            [image.name for image in images],
            np.array([pose.rotation.matrix() for pose in poses]).reshape(-1, 3, 3),
            np.array([image.projection_center() for image in images]).reshape(-1, 3),
            np.arctan(np.array(reach)),
            np.array([point.xyz for point in points]).reshape(-1, 3),
            np.array([point.track.length() for point in points], dtype=int),
        )


def with_lens(model: Any, kind: str) -> tuple[Any, float]:
    """A copy of a reconstruction whose cameras have this lens, adjusted, and its mean reprojection error,
    pixels."""
    pycolmap = colmap.load()
    copy = pycolmap.Reconstruction(model)
    for camera in copy.cameras.values():
        focal, centre = (
            (camera.focal_length_x, camera.focal_length_y),
            (camera.principal_point_x, camera.principal_point_y),
        )
        radial = camera.params[3] if camera.model_name == "SIMPLE_RADIAL" else 0.0
        mean = sum(focal) / 2
        parameters = {
            "SIMPLE_PINHOLE": [mean, *centre],
            "SIMPLE_RADIAL": [mean, *centre, radial],
            "OPENCV": [*focal, *centre, radial, 0.0, 0.0, 0.0],
        }
        camera.model = getattr(pycolmap.CameraModelId, kind)
        camera.params = parameters[kind]
    adjust(copy)
    return copy, float(copy.compute_mean_reprojection_error())


def adjust(model: Any) -> None:
    """Bundle adjustment of everything but the principal points."""
    pycolmap = colmap.load()
    options, config = pycolmap.BundleAdjustmentOptions(), pycolmap.BundleAdjustmentConfig()
    options.print_summary = False
    for image in model.reg_image_ids():
        config.add_image(image)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    with colmap.quiet():  # `pycolmap.bundle_adjustment` would turn the log on again
        pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    model.update_point_3d_errors()


def best_lens(model: Any) -> Any:
    """The reconstruction with the simplest lens that the observations do not contradict."""
    best, error = with_lens(model, MODELS[0])
    for kind in MODELS[1:]:
        richer, lower = with_lens(model, kind)
        if lower < (1 - GAIN) * error:
            best, error = richer, lower
    return best
