"""Formats of other programs, one file each; importing this package registers those that ship.

A new one is a file that declares a `Format`, and its line here.
"""

from mi_refgs.formats import cameras
from mi_refgs.formats.format import FORMATS, Format, Option, Shot, options_of, register, write

register(cameras.CAMERAS)

__all__ = ["FORMATS", "Format", "Option", "Shot", "options_of", "register", "write"]
