"""Folders of pictures as COLMAP and LLFF have them: `images`, smaller copies in `images_2` …, and `masks`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mi_refgs.errors import InputError, abbreviated
from mi_refgs.io.files import inside, is_file
from mi_refgs.io.images import ENDINGS, with_ending

COPIES = (8, 4, 2)
"""Factors by which copies are smaller than the pictures in `images`."""
IMAGES = "images"
MASKS = "masks"


@dataclass(frozen=True)
class PictureFolders:
    """The pictures of a data set. The largest have factor 1: `images`, or copies where it is missing."""

    root: Path
    folders: dict[int, Path]  # by their factor

    @classmethod
    def of(cls, root: Path, flat: bool = False) -> PictureFolders:
        """The folders below `root`, which itself holds the pictures if `flat` allows it and there are none.

        Raises InputError without any.
        """
        found = {k: root / f"{IMAGES}_{k}" for k in COPIES if (root / f"{IMAGES}_{k}").is_dir()}
        if (root / IMAGES).is_dir():
            found[1] = root / IMAGES
        if not found and flat and any(map(_is_picture, root.iterdir())):
            found[1] = root
        if not found:
            raise InputError(f"{root}: {IMAGES}: no such folder; put the pictures there")
        largest = min(found)
        return cls(root, {k // largest: folder for k, folder in found.items()})

    def names(self) -> list[str]:
        """The names of the largest pictures, sorted; pictures below folders count."""
        folder = self.folders[1]
        pattern = "*" if folder == self.root else "**/*"
        return sorted(str(path.relative_to(folder)) for path in folder.glob(pattern) if _is_picture(path))

    def find(self, name: str, downscale: int, whole: bool = False) -> tuple[Path, int] | None:
        """A picture's file, and by what its blocks must still be averaged; None if there is no such file.

        The smallest copy whose factor divides `downscale` serves; `whole` asks for the largest. A copy may
        have another ending than the name. Raises InputError for a name that leads out of the folder.
        """
        for factor, folder in sorted(self.folders.items(), reverse=True):
            if downscale % factor or (whole and factor > 1):
                continue
            file = inside(folder, name)
            if file is None:
                raise InputError(
                    f"{self.root}: {abbreviated(name)} names no file in {folder.name}; move the picture there"
                )
            if there := file if is_file(file) else with_ending(file.with_suffix("")):
                return there, downscale // factor
        return None


def mask_folder(root: Path) -> Path | None:
    """The folder of masks of a data set; None without one."""
    return root / MASKS if (root / MASKS).is_dir() else None


def mask_file(folder: Path, name: str) -> Path:
    """The mask of a picture by its name: `a.jpg.png`, `a.jpg` or `a.png` of `a.jpg`.

    Raises InputError if there is none: others have one.
    """
    for candidate in (f"{name}.png", name, str(Path(name).with_suffix(".png"))):
        file = inside(folder, candidate)
        if file is not None and is_file(file):
            return file
    raise InputError(f"{folder / (name + '.png')}: mask: missing; add it, or remove the folder of masks")


def _is_picture(path: Path) -> bool:
    return path.suffix.lower() in ENDINGS and not path.name.startswith(".")
