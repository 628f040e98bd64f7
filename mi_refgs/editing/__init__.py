"""Edits of a trained scene: which surfels, what is done to them, two scenes as one, the run folder of it."""

from mi_refgs.editing.change import Assignment, Change, apply, assignments
from mi_refgs.editing.edit import Edited, EditOptions, edit
from mi_refgs.editing.joining import join
from mi_refgs.editing.selection import Selection, painted, painted_pixels, select

__all__ = [
    "Assignment",
    "Change",
    "EditOptions",
    "Edited",
    "Selection",
    "apply",
    "assignments",
    "edit",
    "join",
    "painted",
    "painted_pixels",
    "select",
]
