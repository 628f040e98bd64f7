"""Events of a fit: their settings, when they are due, what they do. `decide` has `hold_out`."""

ORDER = (
    # After every step:
    *("densify", "reset_opacity", "propagate", "exposure", "cameras", "follow_object", "photograph_light"),
    *("mesh", "metal_evidence", "restart"),
    # In `Trainer.train` only:
    *("hold_out", "metal", "colour_alone", "more_surfels"),
)
"""The order of the events of an iteration; those that users register come right before the mesh."""


def place(name: str) -> float:
    """Where an event comes in that order."""
    return ORDER.index(name) if name in ORDER else ORDER.index("mesh") - 0.5
