"""Float64 specification of the share of diffuse light that reaches a mesh's vertices: rays one by one."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mi_refgs.reference.occlusion import mesh_hit

Radiance = Callable[[np.ndarray], np.ndarray]


def ambient(
    vertices: np.ndarray,
    faces: np.ndarray,
    normals: np.ndarray,
    directions: np.ndarray,
    light: Radiance,
    outgoing: Callable[[np.ndarray, np.ndarray, bool, np.ndarray], np.ndarray],
    *,
    offset: float,
    bounces: int,
    brightest: float,
) -> np.ndarray:
    """Ratios (V, 3) by the formula at the head of `shade.ambient`.

    normals (V, 3), unit; directions (V, K, 3), unit, with density cosine / π; light(ω) is the light's
    radiance (3,), blurred as for one ray. outgoing(normal, view, free, ratio) is the radiance (3,) that
    leaves a hit, `free` telling if light arrives along its mirror direction. Rays start `offset` off the
    surface.
    """
    ratio = np.ones((len(vertices), 3))
    for _ in range(bounces):
        found = np.zeros_like(ratio)
        for vertex, (place, normal) in enumerate(zip(vertices, normals, strict=True)):
            start = place + offset * normal
            arrives, every = np.zeros(3), np.zeros(3)
            for direction in directions[vertex]:
                radiance = light(direction)
                every += radiance
                distance, face, shares = mesh_hit(vertices, faces, start, direction)
                if not np.isfinite(distance):
                    arrives += radiance
                else:
                    there = shares @ normals[faces[face]]
                    there = there / np.linalg.norm(there)
                    there = -there if there @ direction > 0 else there
                    mirror = direction - 2 * (direction @ there) * there
                    hit = start + distance * direction + offset * there
                    free = not np.isfinite(mesh_hit(vertices, faces, hit, mirror)[0])
                    arrives += outgoing(there, -direction, free, shares @ ratio[faces[face]])
            found[vertex] = arrives / every
        ratio = np.clip(found, 0, brightest)
    return ratio
