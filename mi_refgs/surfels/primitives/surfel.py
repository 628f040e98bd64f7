"""The screen footprint of a surfel: ray-plane intersection in pixel offsets, with the 2D low-pass.

A surfel has centre p, unit tangents t_u, t_v, normal n (camera frame) and standard deviations s_u, s_v. The
ray through a pixel at offset δ from the projected centre meets its plane at depth z and tangent coordinates
(u, v), in units of s:

    w = 1 + c·δ        z = p_z / w        u = a·δ / w        v = b·δ / w                  [2DGS, eq. 8-10]

With q = p/p_z and the projected tangents X_k = t_k.x - q.x t_k.z, Y_k = t_k.y - q.y t_k.z, a and b are the
rows of the inverse of their matrix: a = (Y_v, -X_v) p_z/(s_u q·n), b = (-Y_u, X_u) p_z/(s_v q·n), and
c = n/(q·n), each divided by the focal lengths. Offsets from the centre enter, not pixel coordinates: two
large terms that cancel in the textbook form are gone. Lengths enter as ratios, so the unit of the scene is
free; no difference of two products is rounded twice. Opacity is

    α = min(α_max, o exp(-ρ/2)),   ρ = min(u² + v², 12 |δ|²)                                [2DGS, eq. 11]

and the sample lies at depth z, or at the centre's depth where the low-pass is the smaller (there the
intersection may be anywhere along the ray).
"""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.constants import (
    ALPHA_MAX,
    ALPHA_MIN,
    EDGE_ON_COSINE,
    LOW_PASS_INV_VARIANCE,
    MAX_TURN,
    NORM_FLOOR,
    SIZE_RANGE,
    SORT_DEPTH_RANGE,
    SORT_REACH,
)
from mi_refgs.surfels.primitives import primitive as base
from mi_refgs.surfels.primitives.primitive import Camera, Surfels, cutoff_radius_squared, dot2
from mi_refgs.types import Bool, Float, Point2f, Vector2f, Vector3f


@dataclass(frozen=True)
class SurfelSample(base.OrientedSample):
    """A surfel's footprint at one pixel; u and v are coordinates in its plane."""

    ratio: Float  # of the depth to that of the centre
    low_pass: Bool  # the 2D filter decides


class FootprintAdjoint:
    """Adjoint of `Surfel.evaluate`: sums over pixels of adjoints of a·δ, b·δ, c·δ, times 1, δ.x and δ.y."""

    def __init__(self) -> None:
        self.a, self.b, self.c = ([mi.Float(0)] * 3 for _ in range(3))
        self.depth, self.opacity = mi.Float(0), mi.Float(0)
        self.screen = [mi.Float(0)] * 2

    def add(self, sample: SurfelSample, δalpha: Float, δz: Float, δu: Float = None, δv: Float = None) -> None:
        """With the adjoints of u and v where features vary over the surfel; the low-pass leaves these 0."""
        plane = ~sample.low_pass
        delta, u, v, ratio = sample.delta, sample.u, sample.v, sample.ratio
        # α = o gaussian, unless clamped;  gaussian = exp(-ρ/2)
        δalpha = dr.select(sample.clamped, 0, δalpha)
        self.opacity = dr.fma(δalpha, sample.gaussian, self.opacity)
        minus_2δrho = δalpha * sample.alpha
        # ρ = u² + v²,  u = a·δ / w,  v = b·δ / w
        by_plane = dr.select(plane, -ratio * minus_2δrho, 0)
        δa, δb = u * by_plane, v * by_plane  # of a·δ and b·δ
        self.depth = dr.fma(ratio, δz, self.depth)  # z = p_z / w, or p_z under the low-pass
        δw = -ratio * dr.fma(sample.z, δz, dr.fma(u, u, v * v) * -minus_2δrho)
        if δu is not None:
            δu, δv = (dr.select(plane, ratio * δ, 0) for δ in (δu, δv))
            δa, δb, δw = δa + δu, δb + δv, δw - dr.fma(u, δu, v * δv)
        # In the low-pass, ρ is a multiple of δ·δ.
        by_screen = dr.select(plane, 0, minus_2δrho)
        self.screen = [dr.fma(by_screen, d, total) for d, total in zip(delta, self.screen, strict=True)]
        self.a = _moments(self.a, δa, delta)
        self.b = _moments(self.b, δb, delta)
        self.c = _moments(self.c, dr.select(plane, δw, 0), delta)

    def columns(self, row: list[Float]) -> list[Float]:
        a, b, c = self.a, self.b, self.c
        # δ = pixel - centre enters a·δ, b·δ, c·δ and ρ
        δcentre = [
            dr.fma(LOW_PASS_INV_VARIANCE, screen, -(a[0] * row[i] + b[0] * row[2 + i] + c[0] * row[4 + i]))
            for i, screen in enumerate(self.screen)
        ]
        return [*a[1:], *b[1:], *c[1:], self.depth, *δcentre, self.opacity]


def _moments(total: list[Float], x: Float, delta: Vector2f) -> list[Float]:
    return [total[0] + x, dr.fma(x, delta.x, total[1]), dr.fma(x, delta.y, total[2])]


class Surfel(base.Oriented):
    """A flat Gaussian: the point p(u, v) = position + s_u u t_u + s_v v t_v, n = t_u × t_v. [2DGS, §4.1]"""

    name = "surfel"
    widths = {"position": 3, "rotation": 4, "scale": 2, "opacity": 1}  # noqa: RUF012
    optional = ("curvature",)
    adjoint = FootprintAdjoint
    columns = 10  # a.x a.y b.x b.y c.x c.y p.z centre.x centre.y opacity

    def project(self, surfels: Surfels, camera: Camera) -> base.Footprints:
        """Culled: centre not beyond the near plane, edge-on, opacity below ALPHA_MIN, non-finite."""
        ahead, z, nearness, slope = base.projected(surfels, camera)
        t_u, t_v, n = (camera.rotate_to_camera(t) for t in surfels.frame())
        s, opacity = surfels.scale(), surfels.opacity()
        qn = dr.fma(slope.x, n.x, dr.fma(slope.y, n.y, n.z))
        visible = ahead & dr.detach(
            (dr.abs(qn) > EDGE_ON_COSINE * dr.sqrt(dr.fma(slope.x, slope.x, dr.fma(slope.y, slope.y, 1))))
            & (opacity >= ALPHA_MIN)
            & dr.isfinite(dr.sum(slope) + qn + opacity + s.x + s.y + dr.square(nearness))
        )
        inverse = dr.rcp(dr.select(visible, qn, 1))
        s = dr.clip(dr.select(visible, s * nearness, 1), 1 / SIZE_RANGE, SIZE_RANGE)
        focal = mi.Vector2f(camera.fx, camera.fy)
        along_u, along_v = (mi.Vector2f(*(dr.fma(-slope[i], t.z, t[i]) for i in (0, 1))) for t in (t_u, t_v))
        turned = -inverse if camera.mirrored else inverse  # t_u × t_v = -n there
        of_u, of_v = turned / s.x, turned / s.y
        centre = focal * slope + mi.Vector2f(camera.cx, camera.cy)
        columns = [of_u * along_v.y / focal.x, -of_u * along_v.x / focal.y]
        columns += [-of_v * along_u.y / focal.x, of_v * along_u.x / focal.y]
        columns += [inverse * n.x / focal.x, inverse * n.y / focal.y]
        columns += [z, centre.x, centre.y, opacity]
        columns = [dr.select(visible, column, 0) for column in columns]
        with dr.suspend_grad():
            deviations = along_u * s.x * focal, along_v * s.y * focal
            low, high = _extent(t_u.z * s.x, t_v.z * s.y, *deviations, opacity)
            covered, fine = base.rectangle(centre, low, high, visible, camera), surfels.has("curvature")
            return base.Footprints(columns, *covered, self, fine)

    def evaluate(self, row: list[Float], pixel: Point2f, near: Float) -> SurfelSample:
        delta = mi.Vector2f(pixel.x - row[7], pixel.y - row[8])
        w = dr.fma(row[4], delta.x, dr.fma(row[5], delta.y, 1))
        in_front = w > 0
        ratio = dr.rcp(dr.select(in_front, w, 1))
        u = ratio * dot2(row[0], row[1], delta)
        v = ratio * dot2(row[2], row[3], delta)
        rho_plane = dr.fma(u, u, v * v)
        rho_screen = LOW_PASS_INV_VARIANCE * dr.fma(delta.x, delta.x, delta.y * delta.y)
        low_pass = ~in_front | (rho_screen < rho_plane)
        gaussian = dr.exp(-0.5 * dr.select(low_pass, rho_screen, rho_plane))
        alpha = row[9] * gaussian
        clamped = alpha > ALPHA_MAX
        alpha = dr.select(clamped, ALPHA_MAX, alpha)
        ratio = dr.select(low_pass, 1, ratio)
        z = row[6] * ratio
        valid = (alpha >= ALPHA_MIN) & (z > near)
        return SurfelSample(alpha, z, valid, gaussian, clamped, delta, u, v, ratio, low_pass)

    def normal(self, surfels: Surfels) -> Vector3f:
        return surfels.frame()[2]

    def turns(self, surfels: Surfels, normal: Vector3f) -> dict[str, Vector3f]:
        """n(u, v) = n + u s_u (κ₁ t_u + κ₂ t_v) + v s_v (κ₂ t_u + κ₃ t_v), with κ the `curvature`, the second
        fundamental form in 1/scene unit; the turn per deviation tends to MAX_TURN."""
        if not surfels.has("curvature"):
            return {}
        (t_u, t_v, n), s, κ = surfels.frame(), surfels.scale(), surfels.columns("curvature")
        side = dr.select(dr.detach(dr.dot(n, normal)) < 0, -1, 1)
        turns = []
        for size, (first, second) in zip(s, (κ[:2], κ[1:]), strict=True):
            x, y = (dr.clip(size / MAX_TURN * k, -SIZE_RANGE, SIZE_RANGE) for k in (first, second))
            turns.append(side * MAX_TURN * dr.rsqrt(1 + x * x + y * y) * (x * t_u + y * t_v))
        return dict(zip(("turn_u", "turn_v"), turns, strict=True))

    def turn(self, raw: dict[str, np.ndarray], rows: slice, axis: np.ndarray, offset: np.ndarray) -> None:
        """By the `turns` there."""
        if "curvature" not in raw:
            return
        κ = np.take_along_axis(raw["curvature"][rows], axis[:, None] + [0, 1], axis=1)  # κ₁ κ₂ or κ₂ κ₃
        κ = np.exp(np.take_along_axis(raw["scale"][rows], axis[:, None], axis=1)) / MAX_TURN * κ
        half = offset[:, None] / 2 * MAX_TURN * κ / np.hypot(1, np.linalg.norm(κ, axis=1, keepdims=True))
        # The quaternion times (-half_v, half_u, 0, 1), the rotation about n × (half_u t_u + half_v t_v).
        (x, y, z, w), a, b = raw["rotation"][rows].T, -half[:, 1], half[:, 0]
        x, y, z, w = x + w * a - z * b, y + w * b + z * a, z + x * b - y * a, w - x * a - y * b
        raw["rotation"][rows] = np.stack([x, y, z, w], axis=1)

    def overlaps(self, row: list[Float], low: Point2f, high: Point2f) -> Bool:
        """Whether u² + v² ≤ r², q(δ) = (a·δ)² + (b·δ)² - r² (1 + c·δ)² ≤ 0, at the rectangle's least q: at
        the minimum or on an edge that faces it. [cf. Speedy-Splat, Hanson et al. 2025, §4]"""
        a_x, a_y, b_x, b_y, c_x, c_y, _, x, y, opacity = row[: self.columns]
        r2 = cutoff_radius_squared(opacity) * 1.0005 + 1e-4  # rounding of q
        low, high = mi.Vector2f(low.x - x, low.y - y), mi.Vector2f(high.x - x, high.y - y)
        # The matrix of q of a thin ellipse keeps no digit of its determinant. That of a sum of squares of
        # linear forms is the sum of squares of their cross products, and q itself is best left in squares.
        a_b, a_c, b_c = a_x * b_y - a_y * b_x, a_x * c_y - a_y * c_x, b_x * c_y - b_y * c_x
        determinant = dr.square(a_b) - r2 * dr.fma(a_c, a_c, b_c * b_c)
        xx = dr.fma(a_x, a_x, b_x * b_x) - r2 * c_x * c_x
        xy = dr.fma(a_x, a_y, b_x * b_y) - r2 * c_x * c_y
        yy = dr.fma(a_y, a_y, b_y * b_y) - r2 * c_y * c_y
        ellipse = (determinant > 0) & (xx > 0) & (yy > 0)  # else the contour reaches behind the camera
        along_x, along_y = -r2 * c_x, -r2 * c_y
        scale = r2 / dr.select(ellipse, determinant, 1)
        near_x = dr.clip(-scale * dr.fma(a_c, a_y, b_c * b_y), low.x, high.x)
        near_y = dr.clip(scale * dr.fma(a_c, a_x, b_c * b_x), low.y, high.y)
        on_x = dr.clip(-dr.fma(xy, near_x, along_y) / dr.select(ellipse, yy, 1), low.y, high.y)
        on_y = dr.clip(-dr.fma(xy, near_y, along_x) / dr.select(ellipse, xx, 1), low.x, high.x)

        def inside(x: Float, y: Float) -> Bool:
            delta = mi.Vector2f(x, y)
            u, v = dot2(a_x, a_y, delta), dot2(b_x, b_y, delta)
            return dr.fma(u, u, v * v) <= r2 * dr.square(1 + dot2(c_x, c_y, delta))

        by_plane = inside(near_x, on_x) | inside(on_y, near_y)
        beside_x, beside_y = dr.clip(0, low.x, high.x), dr.clip(0, low.y, high.y)
        by_screen = LOW_PASS_INV_VARIANCE * dr.fma(beside_x, beside_x, beside_y * beside_y) <= r2
        return ~ellipse | by_plane | by_screen

    def depth_near(self, row: list[Float], pixel: Point2f) -> Float:
        """Depth of the surfel's plane there, up to SORT_REACH standard deviations from its centre: sorted by
        centres, the near side of a curved surface would come first. [cf. StopThePop, Radl et al. 2024, §4]"""
        a_x, a_y, b_x, b_y, c_x, c_y, z, x, y = row[:9]
        delta = mi.Vector2f(pixel.x - x, pixel.y - y)
        u, v = dot2(a_x, a_y, delta), dot2(b_x, b_y, delta)
        inside = dr.minimum(1, SORT_REACH * dr.rsqrt(dr.maximum(dr.fma(u, u, v * v), NORM_FLOOR)))
        return z / dr.maximum(dr.fma(inside, dot2(c_x, c_y, delta), 1), 1 / SORT_DEPTH_RANGE)


def _extent(
    depth_u: Float, depth_v: Float, along_u: Vector2f, along_v: Vector2f, opacity: Float
) -> tuple[Vector2f, Vector2f]:
    """Rectangle around the centre, in pixels, that contains every pixel with α ≥ ALPHA_MIN.

    The contour u² + v² = r² projects to a conic; its bounds follow from the tangent lines of the dual conic
    [2DGS, appendix A, with r for 3 and the origin at the projected centre]. A contour that reaches behind the
    camera has none. Depth in depths of the centre, and offset in pixels, of one deviation along t_u and t_v.
    """
    r2 = cutoff_radius_squared(opacity)
    denominator = r2 * (dr.square(depth_u) + dr.square(depth_v)) - 1
    bounded = denominator < -1e-4  # float32 margin: the bounds diverge at 0
    f = r2 / dr.select(bounded, denominator, -1)
    low_pass = dr.sqrt(r2 / LOW_PASS_INV_VARIANCE)
    low, high = [], []
    for axis in range(2):
        x_u, x_v = along_u[axis], along_v[axis]
        middle = f * (x_u * depth_u + x_v * depth_v)
        half = dr.sqrt(dr.maximum(dr.square(middle) - f * (dr.square(x_u) + dr.square(x_v)), 0))
        half = half * 1.0001 + 1e-3  # rounding of the contour itself, in pixels
        low.append(dr.select(bounded, dr.minimum(middle - half, -low_pass), -dr.inf))
        high.append(dr.select(bounded, dr.maximum(middle + half, low_pass), dr.inf))
    return mi.Vector2f(*low), mi.Vector2f(*high)
