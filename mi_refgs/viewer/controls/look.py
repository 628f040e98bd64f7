"""What is shown and how finely: variable, exposure, backdrop, sizes, and a line that says what is seen."""

from __future__ import annotations

from mi_refgs.viewer import resolution
from mi_refgs.viewer.page import Page

STOPS = 6.0
"""Largest exposure either way."""
AUTOMATIC = "automatic"


def add(page: Page) -> None:
    """Add the controls."""
    gui = page.server.gui
    status = gui.add_markdown("starting")
    page.status = lambda text: setattr(status, "content", text)
    with gui.add_folder("View"):
        what = gui.add_dropdown(
            "Show",
            page.drawable.variables,
            hint="The picture, or a variable of what is seen: materials, geometry, terms of the radiance.",
        )
        exposure = gui.add_slider("Exposure", -STOPS, STOPS, 0.25, 0.0, hint="Stops.")
        backdrop = gui.add_dropdown(
            "Backdrop",
            page.drawable.backdrops,
            hint="What is seen behind the object; it is shown alone on all but its surroundings.",
        )
        sizes = {f"{side}²": side for side in resolution.SIDES}
        moving = gui.add_dropdown(
            "Moving",
            (AUTOMATIC, *sizes),
            hint="Pixels while something moves: as many as can be drawn 20 times a second, or these.",
        )
        finest = f"{resolution.FINEST}²"
        still = gui.add_dropdown("Still", tuple(sizes), initial_value=finest, hint="Most pixels at rest.")

    what.on_update(lambda _: page.set(what=what.value))
    backdrop.on_update(lambda _: page.set(backdrop=backdrop.value))
    exposure.on_update(lambda _: page.set(exposure=float(exposure.value)))
    moving.on_update(lambda _: page.set(fixed=sizes.get(moving.value)))
    still.on_update(lambda _: page.set(largest=sizes[still.value]))
