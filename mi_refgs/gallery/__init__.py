"""A gallery of the embedded scenes: what a fit finds of them, under another light, and edited."""

from mi_refgs.gallery.exhibits import EXHIBITS, Exhibit
from mi_refgs.gallery.make import make_gallery

__all__ = ["EXHIBITS", "Exhibit", "make_gallery"]
