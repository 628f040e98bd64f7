"""The mistakes: one or two for every convention and formula of the chain that is easy to get wrong."""

from __future__ import annotations

from benchmarks.mutation.planting import Mistake

MISTAKES = (
    Mistake(
        "depth normals: edges are slopes",
        "mi_refgs/render/depth_normals.py",
        "DEPTH_EDGE_COSINE = 0.2",
        "DEPTH_EDGE_COSINE = 0.0",
        "tests/test_depth_normals.py",
    ),
)
