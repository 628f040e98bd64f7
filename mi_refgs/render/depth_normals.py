"""Normals of the surface that a depth map describes.

Letters: z expected camera depth, A accumulated alpha, X(i, j) the point that pixel (i, j) sees at depth z."""

import drjit as dr
import mitsuba as mi

from mi_refgs.constants import ALPHA_MIN, NORM_FLOOR
from mi_refgs.render.stencil import neighbours
from mi_refgs.splat.camera import Camera
from mi_refgs.types import Bool, Float, Vector3f

DEPTH_EDGE_COSINE = 0.2  # to the viewing ray; below, a depth difference is a step, not a slope


def normals_from_depth(depth: Float, alpha: Float, camera: Camera) -> tuple[Vector3f, Bool]:
    """World normals of a depth map by central differences, facing the camera, and where they are valid.

    depth: (H·W) camera depth z, raster order, scene units; alpha: (H·W), for validity only. Unit normals, or
    zero where invalid: at the image border, where a pixel or a neighbour has A < 1/255, and points in a line.
    Gradients flow to depth. Source: 2DGS, Huang et al. 2024, eq. 15."""
    width, height = camera.width, camera.height
    steps = ((-1, 0), (1, 0), (0, -1), (0, 1))
    pixel = camera.pixel_centres()
    ray = mi.Vector3f((pixel.x - camera.cx) / camera.fx, (pixel.y - camera.cy) / camera.fy, 1)
    # In units of the pixel's own depth: what is compared with a floor below is near 1 in scenes of any size.
    unit = dr.detach(dr.select(depth > 0, dr.rcp(dr.select(depth > 0, depth, 1)), 0))
    left, right, up, down = neighbours(depth, width, height, steps)

    # X(right) - X(left) = ray (z₁ - z₀) + (z₁ + z₀) x / f: no large terms cancel.
    along_x = unit * (right - left) * camera.fx * ray + mi.Vector3f(unit * (right + left), 0, 0)
    along_y = unit * (down - up) * camera.fy * ray + mi.Vector3f(0, unit * (down + up), 0)
    normal = dr.cross(along_x, along_y)
    cosine = dr.detach(dr.dot(normal, ray))
    normal = dr.select(cosine > 0, -normal, normal)

    covered = dr.select(dr.detach(alpha) >= ALPHA_MIN, mi.Float(1), mi.Float(0))
    around = neighbours(covered, width, height, (*steps, (0, 0)))
    inside = (pixel.x > 1) & (pixel.x < width - 1) & (pixel.y > 1) & (pixel.y < height - 1)
    length2 = dr.squared_norm(normal)
    valid = inside & (sum(around[1:], around[0]) > 4.5) & (dr.detach(length2) > NORM_FLOOR)
    valid &= dr.square(cosine) > DEPTH_EDGE_COSINE**2 * dr.detach(length2) * dr.squared_norm(ray)
    normal = normal * dr.rsqrt(dr.select(valid, length2, 1.0))
    return dr.select(valid, camera.rotate_to_world(normal), 0.0), valid
