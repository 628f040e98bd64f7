"""Which oracle a table's footprints have."""

from __future__ import annotations

import numpy as np

from mi_refgs.reference import gaussian, surfel
from mi_refgs.reference.footprint import Footprints


def primitive_of(raw: dict[str, np.ndarray]) -> Footprints:
    """3D Gaussians have a third standard deviation."""
    return gaussian if raw["scale"].shape[1] == 3 else surfel
