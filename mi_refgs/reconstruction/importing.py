"""From a PLY file that another program has written to a `Reconstruction`."""

from __future__ import annotations

from pathlib import Path

from mi_refgs.formats.gaussian_ply import method_of, read_splats
from mi_refgs.kernels.device import require_supported_variant
from mi_refgs.reconstruction.provenance import Provenance
from mi_refgs.reconstruction.reconstruction import Reconstruction


def import_splats(path: str | Path, *, linear: bool = False) -> Reconstruction:
    """Read a PLY file of 3DGS or 2DGS: `refgs import`, in memory; `save` writes the run folder.

    linear: its colours are linear radiance, as this package fits them; otherwise they are display-encoded, as
    3DGS and 2DGS write them. It has neither light nor mesh, and its cameras are around the object, z up.
    Raises InputError for a file that holds anything else, and where no Mitsuba variant is set that the
    renderer can use.
    """
    require_supported_variant("mi_refgs.import_splats")
    file = Path(path)
    trained = read_splats(file, linear)
    return Reconstruction(trained, Provenance(method_of(trained, file.stem)))
