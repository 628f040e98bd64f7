"""Pictures that are decoded when they are asked for: 300 photographs of 12 Mpx would be 11 GB.

What is kept of a picture is its decoded file: 8-bit numbers where the view shows them as they are, and
float32 where pixels were averaged or resampled, so a picture is the same however often it is decoded.
"""

from __future__ import annotations

import threading
import weakref
from collections import OrderedDict
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from mi_refgs.data.picture_files import PictureFile

BUDGET = 2**30
"""Bytes of decoded pictures that are kept in a process: 28 of 12 Mpx, or a thousand of 600 × 600."""


class PictureStore:
    """Decoded pictures; those that were asked for last are kept, and none longer than its `Picture`.

    Threads may share it: the same picture is then decoded twice at worst.
    """

    def __init__(self, budget: int = BUDGET) -> None:
        self.budget = budget
        self.bytes = 0
        self._kept: OrderedDict[int, np.ndarray] = OrderedDict()
        self._lock = threading.RLock()  # a picture may be collected, and so dropped, within it

    def pixels(self, picture: Picture) -> np.ndarray:
        """The pixels of a picture, decoded if they are not kept; errors as `PictureFile.decode`."""
        key = id(picture)
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key]
        decoded = picture.file.decode()
        with self._lock:
            self.drop(key)  # what another thread has decoded meanwhile
            self._kept[key] = decoded
            self.bytes += decoded.nbytes
            while self.bytes > self.budget and self._kept:
                self.drop(next(iter(self._kept)))
        return decoded

    def has_room(self, size: int) -> bool:
        """Whether so many bytes more are kept without dropping others."""
        return self.bytes + size <= self.budget

    def drop(self, key: int) -> None:
        """Keep the picture of this `id` no longer."""
        with self._lock:
            dropped = self._kept.pop(key, None)
            self.bytes -= 0 if dropped is None else dropped.nbytes


STORE = PictureStore()
"""The pictures of this process."""


class Picture:
    """The pixels of a view, in a file."""

    def __init__(
        self, file: PictureFile, background: float, store: PictureStore = STORE, decode: bool = True
    ) -> None:
        """Decode the file while there is room, so that what is wrong with it is said when it is read.

        `decode`: false for a look at cameras alone. Raises InputError as `PictureFile.decode` does.
        """
        self.file, self.background, self.store = file, background, store
        weakref.finalize(self, store.drop, id(self)).atexit = False
        whole = store.pixels(self) if decode and store.has_room(file.largest) else None
        self.has_alpha = file.has_alpha() if whole is None else whole.shape[-1] == 4

    def planes(self) -> tuple[np.ndarray, np.ndarray | None]:
        """Colour and alpha, as `PictureFile.read` gives them."""
        return self.file.planes(self.store.pixels(self), self.background)
