"""Edits of a trained scene: selection, changes, union of two scenes."""

from mi_refgs.editing.change import Change, apply, assignments
from mi_refgs.editing.edit import Edited, EditOptions, before_and_after, edit
from mi_refgs.editing.joining import join
from mi_refgs.editing.selection import Selection, select

__all__ = [
    "Change",
    "EditOptions",
    "Edited",
    "Selection",
    "apply",
    "assignments",
    "before_and_after",
    "edit",
    "join",
    "select",
]
