"""Data sets: reading folders of pictures with cameras, and path-tracing new ones."""

from mi_refgs.data.colmap import ColmapReader
from mi_refgs.data.glossy import GlossyReader
from mi_refgs.data.llff import LlffReader
from mi_refgs.data.readers import register
from mi_refgs.data.transforms import TransformsReader

# Here, so that it is there before any other: the reader that was registered last is asked first.
# Folders that have several layouts are read by the one that says most.
register(LlffReader())
register(GlossyReader())
register(ColmapReader())
register(TransformsReader())
