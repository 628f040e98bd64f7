"""The render thread: coarse frames during motion, refined at rest by one sample per pixel after another.
Callbacks of the page run on other threads: they only queue tasks here."""

import math
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.io.images import to_8_bits
from mi_refgs.render.display import image_array
from mi_refgs.types import Float
from mi_refgs.viewer import resolution
from mi_refgs.viewer.pose import Pose
from mi_refgs.viewer.reconstruction_view import DisplayOptions, ReconstructionView, displayed_planes
from mi_refgs.viewer.resolution import COARSE, DONE, LARGE, NOTHING, SHOWN_AT


@dataclass(eq=False)
class Client:
    """An open page: its view, and the progress of its image."""

    deliver: Callable[[np.ndarray, int, float], None]  # (H, W, 3) uint8, COARSE … DONE, seconds of a sample
    pose: Pose | None = None
    window: tuple[int, int] = (0, 0)  # pixels
    side: int = resolution.COARSEST  # resolution level of the next image during motion
    changed: float = -math.inf  # time of the last change of its view or of the scene
    version: int = 0  # counts these changes
    progress: int = DONE
    sums: list[Float] = field(default_factory=list)  # planes (H*W,), over samples of a supersampled image


class RenderLoop:
    """Draws a scene for clients; `step` and `run` belong to the render thread, the rest to any thread."""

    def __init__(self, scene: ReconstructionView, clock: Callable[[], float] = time.monotonic) -> None:
        self.scene, self.clock = scene, clock
        self.clients: dict[int, Client] = {}  # changed by any thread
        self.look = DisplayOptions(backdrop=scene.backdrops[0])
        self.report: Callable[[str], None] = lambda message: None  # called with a sentence about a failure
        self.delivered = 0  # images
        self._tasks: dict[Any, Callable[[], None]] = {}
        self._wake = threading.Condition()

    def submit(self, key: Any, task: Callable[[], None], *, changes: bool = True) -> None:
        """Queue a task in place of a waiting one of this key; if it `changes`, all images are outdated."""

        def run() -> None:
            task()
            if changes:
                self.change()

        with self._wake:
            self._tasks[key] = run
            self._wake.notify()

    def change(self, number: int | None = None, **fields: Any) -> None:
        """Outdate the image of a client, or of all, and set fields of it."""
        with self._wake:
            for client in (c for n, c in tuple(self.clients.items()) if number in (None, n)):
                for name, value in fields.items():
                    setattr(client, name, value)
                client.changed, client.progress, client.sums = self.clock(), NOTHING, []
                client.version += 1
            self._wake.notify()

    def display(self, **fields: Any) -> None:
        """Set fields of the display options; every image is outdated."""
        with self._wake:
            self.look = replace(self.look, **fields)
            self.change()

    def run(self) -> None:
        """Draw until KeyboardInterrupt."""
        while True:
            if (wait := self.step()) == math.inf:
                dr.flush_malloc_cache()  # buffers of other image sizes
            with self._wake:
                if wait > 0 and not self._tasks:
                    self._wake.wait(None if wait == math.inf else wait)

    def step(self) -> float:
        """Run the tasks, then draw the sample that is due; returns the seconds until the next one, or inf."""
        with self._wake:
            tasks, self._tasks = self._tasks, {}
        for task in tasks.values():
            self._succeeds(task)

        def wait_of(client: Client) -> float:
            return resolution.due(client.progress, self.clock() - client.changed)

        waiting = [client for client in tuple(self.clients.values()) if client.pose is not None]
        if not waiting:
            return math.inf
        client = min(waiting, key=lambda each: (wait_of(each), each.progress))
        if (wait := wait_of(client)) > 0:
            return wait
        version = client.version
        if not self._succeeds(lambda: self._advance(client)):
            with self._wake:
                if client.version == version:  # else it would fail again at once, without an end
                    client.progress, client.sums = DONE, []
        return 0.0

    def _succeeds(self, task: Callable[[], None]) -> bool:
        """Whether a task succeeds; a failure is reported in one sentence."""
        try:
            task()
            return True
        except InputError as error:
            self.report(str(error))
        except Exception as error:
            traceback.print_exc()
            where = "the image stays as it was; the terminal shows where it failed"
            self.report(f"{type(error).__name__}: {where}")
        return False

    def _advance(self, client: Client) -> None:
        """Draw a client's next sample and deliver the image, unless it is outdated by then."""
        with self._wake:
            version, before, sums = client.version, client.progress, client.sums
            pose, window, look = client.pose, client.window, self.look
        assert pose is not None
        begin = self.clock()
        still = resolution.still_side(*window, look.largest)
        side = min(client.side, still) if before == NOTHING else still
        progress = before + 1 if before >= LARGE else LARGE if side >= still else COARSE
        # One sample per pixel, added to those before.
        width, height = resolution.size_of(side, resolution.shape_of(*window))
        offset = resolution.offset_of(progress - LARGE) if progress >= LARGE else (0.0, 0.0)
        planes = self.scene.draw(pose.camera(width, height, offset), look, progress >= LARGE)
        sums = [a + b for a, b in zip(sums, planes, strict=True)] if sums else planes
        dr.eval(sums)
        shown = None  # the mean as an image
        if progress in SHOWN_AT:
            share = dr.opaque(type(sums[0]), 1 / max(progress - COARSE, 1))
            mean = [plane * share for plane in sums]
            shown = image_array(displayed_planes(mean, look, self.scene.depths(pose)), height, width)
        dr.sync_thread()
        taken = self.clock() - begin
        with self._wake:
            if before == NOTHING:
                client.side = resolution.moving_side(side, taken, still)
            if client.version == version:
                client.progress, client.sums = progress, sums if LARGE <= progress < DONE else []
            elif before != NOTHING:  # a coarse image is delivered: else nothing would be during motion
                return
        if shown is not None:
            self.delivered += 1
            client.deliver(to_8_bits(shown), progress, taken)
