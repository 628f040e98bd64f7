"""Readers of data sets: folders of images with cameras."""

from mi_refgs.data.colmap import ColmapReader
from mi_refgs.data.dataset import Reader, register_reader
from mi_refgs.data.glossy import GlossyReader
from mi_refgs.data.llff import LlffReader
from mi_refgs.data.transforms import TransformsReader

# The reader registered last is asked first: the layout that says most wins in folders that have several.
_READERS: tuple[Reader, ...] = (LlffReader(), GlossyReader(), ColmapReader(), TransformsReader())
for _reader in _READERS:
    register_reader(_reader)
