"""The screen footprint of a 3D Gaussian by EWA: the affine approximation of its projection, and a low-pass.

A Gaussian has centre p (camera frame), unit axes t_0 t_1 t_2 and standard deviations s_k. With the slope
q = (p_x, p_y)/p_z, clamped to GAUSSIAN_SLOPE_MARGIN around the image, one standard deviation along t_k
moves the projected point by f v_k pixels, and the screen covariance is the sum of their outer products:

    v_k = (s_k / p_z) (t_k.xy - q t_k.z)          Σ' = Σ_k (f v_k) (f v_k)ᵀ + λ I      [Zwicker 2001, eq. 31;
                                                                                   3DGS, Kerbl 2023, eq. 5]
    α = min(α_max, o exp(-ρ/2)),   ρ = δᵀ Σ'⁻¹ δ

for a pixel at offset δ from the projected centre, and the sample lies at the depth of the centre. λ is the
low-pass. Lengths enter as ratios to the depth, and ρ as the sum of two squares,

    ρ = (a·δ)² + (b δ_y)²,   a = √(Σ'_yy / det) (1, -Σ'_xy / Σ'_yy),   b = 1 / √Σ'_yy

whose determinant is a sum of squares too: (v_i × v_j) = (s_i s_j / p_z²) (q, 1)·t_k. Nothing cancels, so that
needles and pancakes keep their digits in float32.
"""

import drjit as dr
import mitsuba as mi

from mi_refgs.constants import ALPHA_MAX, ALPHA_MIN, GAUSSIAN_LOW_PASS, GAUSSIAN_SLOPE_MARGIN, SIZE_RANGE
from mi_refgs.surfels.primitives import primitive as base
from mi_refgs.surfels.primitives.primitive import Camera, Surfels, cutoff_radius_squared, dot2
from mi_refgs.types import Bool, Float, Point2f, Vector2f, Vector3f


def _as_surfel(columns: list[Float]) -> list[Float]:
    """Rows of a surfel without perspective: c = 0; λ keeps ρ below that of the surfel's low-pass."""
    a_x, a_y, b, *others = columns
    none = dr.zeros(mi.Float, dr.width(b))
    return [a_x, a_y, none, b, none, none, *others]


class GaussianAdjoint:
    """Adjoint of `Gaussian.evaluate`: sums over pixels of the adjoints of u = a·δ and v = b δ_y, times δ."""

    def __init__(self) -> None:
        self.u, self.v = [mi.Float(0)] * 3, [mi.Float(0)] * 2
        self.depth, self.opacity = mi.Float(0), mi.Float(0)

    def add(self, sample: base.OrientedSample, δalpha: Float, δz: Float) -> None:
        delta = sample.delta
        δalpha = dr.select(sample.clamped, 0, δalpha)
        self.opacity = dr.fma(δalpha, sample.gaussian, self.opacity)
        self.depth = self.depth + δz
        slope = -δalpha * sample.alpha  # α = o exp(-(u² + v²) / 2)
        δu, δv = sample.u * slope, sample.v * slope
        self.u = [self.u[0] + δu, dr.fma(δu, delta.x, self.u[1]), dr.fma(δu, delta.y, self.u[2])]
        self.v = [self.v[0] + δv, dr.fma(δv, delta.y, self.v[1])]

    def columns(self, row: list[Float]) -> list[Float]:
        (u, *δa), (v, δb) = self.u, self.v
        return [*δa, δb, self.depth, -u * row[0], -dr.fma(u, row[1], v * row[2]), self.opacity]


class Gaussian(base.Oriented):
    """A 3D Gaussian with three standard deviations along the axes of a rotation. [3DGS, §4]"""

    name = "gaussian"
    widths = {"position": 3, "rotation": 4, "scale": 3, "opacity": 1}  # noqa: RUF012
    adjoint = GaussianAdjoint
    columns = 7  # a.x a.y b p.z centre.x centre.y opacity
    rows_as = {"surfel": _as_surfel}  # noqa: RUF012
    first_order = True

    def project(self, surfels: Surfels, camera: Camera) -> base.Footprints:
        """Culled: centre not beyond the near plane, opacity below ALPHA_MIN, non-finite."""
        ahead, z, nearness, slope = base.projected(surfels, camera)
        axes = [camera.rotate_to_camera(t) for t in surfels.frame()]
        s, opacity = surfels.scale(), surfels.opacity()
        visible = ahead & dr.detach(
            (opacity >= ALPHA_MIN) & dr.isfinite(dr.sum(slope) + dr.sum(s) + opacity + dr.square(nearness))
        )
        s = dr.clip(dr.select(visible, s * nearness, 1), 1 / SIZE_RANGE, SIZE_RANGE)
        focal, middle = mi.Vector2f(camera.fx, camera.fy), mi.Vector2f(camera.cx, camera.cy)
        # In units of slope rather than pixels, so that fourth powers of sizes fit float32.
        q = _near_image(dr.select(visible, slope, 0), camera)
        across = [mi.Vector2f(*(dr.fma(-q[i], t.z, t[i]) for i in range(2))) for t in axes]
        along = [t * size for t, size in zip(across, s, strict=True)]
        facing = [dr.fma(q.x, t.x, dr.fma(q.y, t.y, t.z)) for t in axes]
        low_pass = GAUSSIAN_LOW_PASS / dr.square(focal)
        unfiltered = mi.Vector2f(*(sum(dr.square(v[i]) for v in along) for i in range(2)))
        xx, yy = unfiltered + low_pass
        xy = sum(v.x * v.y for v in along)
        crossed = sum(dr.square(s[k - 2] * s[k - 1] * facing[k]) for k in range(3))
        determinant = crossed + low_pass.x * yy + low_pass.y * unfiltered.x
        a = dr.sqrt(yy * dr.rcp(determinant))
        centre = focal * slope + middle
        columns = [a / focal.x, -a * xy / (yy * focal.y), dr.rsqrt(yy) / focal.y]
        columns += [z, centre.x, centre.y, opacity]
        columns = [dr.select(visible, column, 0) for column in columns]
        with dr.suspend_grad():
            half = dr.sqrt(cutoff_radius_squared(opacity) * mi.Vector2f(xx, yy))
            half = half * dr.abs(focal) * 1.0001 + 1e-3  # rounding of the contour itself, in pixels
            return base.Footprints(columns, *base.rectangle(centre, -half, half, visible, camera), self)

    def evaluate(self, row: list[Float], pixel: Point2f, near: Float) -> base.OrientedSample:
        delta = mi.Vector2f(pixel.x - row[4], pixel.y - row[5])
        u, v = dot2(row[0], row[1], delta), row[2] * delta.y
        gaussian = dr.exp(-0.5 * dr.fma(u, u, v * v))
        alpha = row[6] * gaussian
        clamped = alpha > ALPHA_MAX
        alpha = dr.select(clamped, ALPHA_MAX, alpha)
        return base.OrientedSample(alpha, row[3], alpha >= ALPHA_MIN, gaussian, clamped, delta, u, v)

    def normal(self, surfels: Surfels) -> Vector3f:
        """The shortest axis, the third of equal ones; which one it is has no derivative. [3DGS-DR, §3.2]"""
        first, second, third = surfels.frame()
        s = dr.detach(surfels.scale())
        return dr.select(s.z <= dr.minimum(s.x, s.y), third, dr.select(s.x < s.y, first, second))

    def overlaps(self, row: list[Float], low: Point2f, high: Point2f) -> Bool:
        """Whether the least ρ of the rectangle, on an edge that faces the centre, is within the contour."""
        a_x, a_y, b, _, x, y, opacity = row[: self.columns]
        r2 = cutoff_radius_squared(opacity) * 1.0005 + 1e-4  # rounding of ρ
        low, high = mi.Vector2f(low.x - x, low.y - y), mi.Vector2f(high.x - x, high.y - y)
        near_x, near_y = dr.clip(0, low.x, high.x), dr.clip(0, low.y, high.y)
        # Along an edge, ρ is a parabola: least at y = -x a_x a_y / (a_y² + b²) for x, where a·δ = 0 for y.
        on_x = dr.clip(-near_x * a_x * a_y / dr.fma(a_y, a_y, b * b), low.y, high.y)
        on_y = dr.clip(-near_y * a_y / a_x, low.x, high.x)

        def inside(x: Float, y: Float) -> Bool:
            u = dot2(a_x, a_y, mi.Vector2f(x, y))
            return dr.fma(u, u, dr.square(b * y)) <= r2

        return inside(near_x, on_x) | inside(on_y, near_y)

    def depth_near(self, row: list[Float], pixel: Point2f) -> Float:
        """The centre's depth: samples lie there, and other programs fit in this order. [3DGS, §6]"""
        return row[3]


def _near_image(slope: Vector2f, camera: Camera) -> Vector2f:
    """Slopes clamped to GAUSSIAN_SLOPE_MARGIN around the film, without gradient beyond."""
    limited = []
    width, height = camera.film or (camera.width, camera.height)
    margins = (-GAUSSIAN_SLOPE_MARGIN, 1 + GAUSSIAN_SLOPE_MARGIN)
    axes = zip(slope, (camera.fx, camera.fy), camera.centre, (width, height), strict=True)
    for x, focal, middle, size in axes:
        ends = [(margin * size - middle) / focal for margin in margins]
        limited.append(dr.clip(x, dr.minimum(*ends), dr.maximum(*ends)))
    return mi.Vector2f(*limited)
