"""Rays of the GGX lobe, detached: visible normals at points of a golden-ratio spiral, spread evenly for any
number of rays, that every pixel turns by a hash of its own index."""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.shade.points import safe_normalize
from mi_refgs.types import Color3f, Float, UInt32, Vector3f

GOLDEN = 2654435769  # 2³² / golden ratio: multiples of it, modulo 2³², are the most even sequence on a circle
COSINE_FLOOR = 1e-3  # smallest n·v of a lobe: a view from behind is taken as a grazing one
HORIZON = 1e-6  # smallest n·l of a ray: what goes below leaves no light, and 1/(n·l)² fits float32


def lobe_turn(index: UInt32) -> UInt32:
    """The turn of the points of pixels `index` as a 32-bit fraction."""
    return mi.UInt32(mi.sample_tea_32(index, dr.zeros(mi.UInt32, dr.width(index)))[0])


def lobe_point(turn: UInt32, ray: UInt32, count: UInt32) -> tuple[Float, Float]:
    """Point `ray` of `count` in the unit square, turned along its second coordinate; the first is the middle
    of one of `count` equal steps: jittered, one far out in the lobe's tail would spoil its pixel."""
    turned = mi.Float((ray * GOLDEN + turn) >> 8) * 2.0**-24
    return (mi.Float(ray) + 0.5) / mi.Float(count), turned


@dataclass(frozen=True)
class Lobe:
    """The GGX lobes of N points, ready to be sampled; α = roughness², height-correlated Smith, Schlick."""

    frame: Any  # mi.Frame3f around the normals
    view: Vector3f  # local, unit, above the horizon
    α: Float
    f0: Float  # mean of the channels
    turn: UInt32  # of the points, see `lobe_turn`

    @staticmethod
    def of(normal: Vector3f, view: Vector3f, roughness: Float, f0: Color3f, pixel: UInt32 = None) -> "Lobe":
        """Lobes around unit normals, seen from unit directions; lane i has the points of `pixel` i."""
        frame = mi.Frame3f(normal)
        local = frame.to_local(view)
        local.z = dr.maximum(local.z, COSINE_FLOOR)
        return Lobe(
            frame,
            safe_normalize(local),
            dr.square(dr.clip(roughness, 0, 1)),
            dr.clip((f0.x + f0.y + f0.z) * (1 / 3), 0, 1),
            lobe_turn(dr.arange(mi.UInt32, dr.width(normal)) if pixel is None else pixel),
        )

    def sample(self, ray: UInt32, count: UInt32) -> tuple[Vector3f, Float]:
        """World direction of ray `ray` of `count`, and its weight f cosθ / density = F G / G₁, 0 below the
        horizon. [Dupuy and Benyoub 2023, "Sampling Visible GGX Normals with Spherical Caps"; Heitz 2018]"""
        along, around = lobe_point(self.turn, ray, count)
        stretched = dr.normalize(mi.Vector3f(self.α * self.view.x, self.α * self.view.y, self.view.z))
        z = dr.fma(1 - along, 1 + stretched.z, -stretched.z)
        ring = dr.sqrt(dr.maximum(1 - z * z, 0))
        sin, cos = dr.sincos(dr.two_pi * around)
        cap = mi.Vector3f(ring * cos, ring * sin, z) + stretched
        half = safe_normalize(mi.Vector3f(self.α * cap.x, self.α * cap.y, dr.maximum(cap.z, HORIZON)))
        v_h = dr.clip(dr.dot(self.view, half), 0, 1)
        local = dr.fma(2 * v_h, half, -self.view)
        lit = local.z > HORIZON
        shadow_v = self._smith(self.view.z)
        shadow_l = self._smith(dr.select(lit, local.z, 1))
        grazing = dr.square(dr.square(1 - v_h)) * (1 - v_h)
        weight = dr.fma(1 - self.f0, grazing, self.f0) * (1 + shadow_v) / (1 + shadow_v + shadow_l)
        return self.frame.to_world(local), dr.select(lit, weight, 0)

    def _smith(self, cosine: Any) -> Any:
        """Λ of GGX above the horizon."""
        return 0.5 * (dr.sqrt(1 + self.α * self.α * (dr.rcp(cosine * cosine) - 1)) - 1)
