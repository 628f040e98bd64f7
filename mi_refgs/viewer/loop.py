"""The one thread that renders: for whoever looks, small pictures while something moves, better ones after.

A picture is drawn in steps of one sample a pixel; what has changed meanwhile is seen between two of them, and
what was under way is then dropped. Callbacks of the page run on other threads: they only leave a note here.
"""

from __future__ import annotations

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
from mi_refgs.viewer import resolution
from mi_refgs.viewer.compare import Compared
from mi_refgs.viewer.pose import Pose
from mi_refgs.viewer.resolution import COARSE, DONE, LARGE, NOTHING, SHOWN_AT
from mi_refgs.viewer.tonemap import DisplayOptions, shown_planes, to_bytes
from mi_refgs.viewer.viewer_scene import SampleRequest, SampleResult, ViewerScene

FAR = 160.0
"""Depth that pages can show at most, scene units: viser packs it into 24 bits of 1e-5."""


@dataclass(frozen=True, eq=False)
class DeliveredImage:
    """A picture for a page."""

    image: np.ndarray  # (H, W, 3) uint8
    shown: int  # how good it is, from resolution.COARSE to resolution.DONE
    seconds: float  # that its last sample took
    depth: np.ndarray | None = None  # (H, W) float32, where the page asked for it
    samples: int = 1  # of a pixel


@dataclass(eq=False)
class Client:
    """One page: what it looks at, and how far its picture is."""

    deliver: Callable[[DeliveredImage], None]
    pose: Pose | None = None
    window: tuple[int, int] = (0, 0)  # pixels
    look: DisplayOptions = field(default_factory=DisplayOptions)
    largest: int = resolution.FINEST  # rung while nothing moves, at most
    fixed: int | None = None  # rung while something moves; None: by the time that pictures take
    depth: bool = False  # whether it wants depth
    compared: Compared | None = None  # a test view that it shows beside its picture
    side: int = resolution.COARSEST  # rung of the next small picture
    changed: float = -math.inf  # when its view or the scene changed last
    version: int = 0  # of both
    shown: int = DONE
    sums: list[Any] = field(default_factory=list)  # planes, over samples of a smooth picture

    def size(self, side: int, square: bool) -> tuple[int, int]:
        """Pixels of a rung in the shape of its window; if they are `square`, in exactly that shape."""
        width, height = self.window
        exact = max(width, 1) / max(height, 1)
        return resolution.size_of(side, exact if square else resolution.shape_of(width, height))


class RenderLoop:
    """Draws a scene for visitors; `step` and `run` belong to the thread that renders, the rest to any."""

    def __init__(self, drawable: ViewerScene, clock: Callable[[], float] = time.monotonic) -> None:
        self.drawable, self.clock = drawable, clock
        self.visitors: dict[int, Client] = {}
        self.failed: Callable[[str], None] = lambda message: None  # told of what fails, in one sentence
        self.pictures = 0  # that were sent
        self.smooth = True  # whether pictures that stay are averaged over samples
        self._notes: dict[Any, Callable[[], None]] = {}
        self._wake = threading.Condition()
        self._stopped = False

    # ---------------- from any thread ----------------

    def ask(self, key: Any, note: Callable[[], None], *, changes: bool = True) -> None:
        """Let the renderer's thread call `note`; a later one with the same key takes its place.

        `changes`: whether pictures are to be drawn again.
        """

        def whole() -> None:
            note()
            if changes:
                self.change()

        with self._wake:
            self._notes[key] = whole
            self._wake.notify()

    def look(self, number: int, pose: Pose, window: tuple[int, int]) -> None:
        """A visitor looks from there, with a window of so many pixels."""
        with self._wake:
            visitor = self.visitors.get(number)
            if visitor is None:
                return
            visitor.pose, visitor.window = pose, window
            self._restart(visitor)
            self._wake.notify()

    def change(self, number: int | None = None, **fields: Any) -> None:
        """The picture of a visitor, or of all, is old; sets these fields of it."""
        with self._wake:
            for visitor in (v for n, v in self.visitors.items() if number in (None, n)):
                for name, value in fields.items():
                    setattr(visitor, name, value)
                self._restart(visitor)
            self._wake.notify()

    def _restart(self, visitor: Client) -> None:
        visitor.changed, visitor.shown, visitor.sums = self.clock(), NOTHING, []
        visitor.version += 1

    def enter(self, number: int, visitor: Client) -> None:
        """A page is open."""
        with self._wake:
            self.visitors[number] = visitor

    def leave(self, number: int) -> None:
        """A page is closed."""
        with self._wake:
            self.visitors.pop(number, None)

    def stop(self) -> None:
        """Let `run` return."""
        with self._wake:
            self._stopped = True
            self._wake.notify()

    # ---------------- on the renderer's thread ----------------

    def run(self) -> None:
        """Draw until `stop`."""
        while not self._stopped:
            wait = self.step()
            if wait == math.inf:
                dr.flush_malloc_cache()  # what the sizes of pictures have left there
            with self._wake:
                if wait > 0 and not self._notes and not self._stopped:
                    self._wake.wait(None if wait == math.inf else wait)

    def step(self) -> float:
        """Read the notes, then draw the sample that is due; returns the seconds until the next one is.

        0 after a sample was drawn; inf while there is nothing to do.
        """
        with self._wake:
            notes, self._notes = self._notes, {}
        for note in notes.values():
            self._guarded(note)
        now = self.clock()
        waiting = [
            (resolution.due(v.shown if self.smooth or v.shown < LARGE else DONE, now - v.changed), v.shown, v)
            for v in tuple(self.visitors.values())
            if v.pose is not None
        ]
        if not waiting:
            return math.inf
        wait, _, visitor = min(waiting, key=lambda entry: entry[:2])  # who sees least goes first
        if wait > 0:
            return wait
        version = visitor.version
        if not self._guarded(lambda: self._advance(visitor)):
            with self._wake:
                if visitor.version == version:  # else it would fail again at once, without an end
                    visitor.shown, visitor.sums = DONE, []
        return 0.0

    def _guarded(self, task: Callable[[], None]) -> bool:
        """Whether a task succeeds. The page is told of a failure in one sentence, and goes on."""
        try:
            task()
        except InputError as error:
            self.failed(str(error))
        except Exception as error:
            traceback.print_exc()
            reason = (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".")
            self.failed(f"{reason}; what was shown stays, and the terminal shows where this failed")
        else:
            return True
        return False

    def _advance(self, visitor: Client) -> None:
        """Draw a visitor's next sample and send the picture, unless it is old by then."""
        with self._wake:
            version, shown, pose, compared = visitor.version, visitor.shown, visitor.pose, visitor.compared
            sums = visitor.sums
        assert pose is not None
        begin = self.clock()
        if compared is not None:
            image, depth, reached = compared.picture(self.drawable, visitor.look, visitor.window), None, DONE
        else:
            still = resolution.still_side(*visitor.window, visitor.largest)
            moving = visitor.fixed or min(visitor.side, still)
            side = moving if shown == NOTHING else still
            reached = shown + 1 if shown >= LARGE else (LARGE if side >= still else COARSE)
            sample = self._sample(visitor, pose, side, reached)
            sampled = self.drawable.draw(sample)
            sums = added(sums, sampled.planes)
            count = max(reached - LARGE, 1)
            image = None
            if reached <= LARGE or reached in SHOWN_AT:
                share = dr.opaque(type(sums[0]), 1 / count)
                mean = [plane * share for plane in sums] if count > 1 else sums
                image = to_bytes(shown_planes(mean, visitor.look), sample.width, sample.height)
            depth = self._depth(visitor, sampled, sample) if image is not None else None
            dr.sync_thread()
        taken = self.clock() - begin
        with self._wake:
            if compared is None and shown == NOTHING and visitor.fixed is None:
                visitor.side = resolution.moving_side(side, taken, still)
            if visitor.version == version:
                visitor.shown, visitor.sums = reached, sums if LARGE < reached < DONE else []
            elif shown != NOTHING:  # a small picture is shown all the same: else nothing is while it moves
                return
        if image is not None:
            self.pictures += 1
            samples = 1 if compared is not None else max(reached - LARGE, 1)
            visitor.deliver(DeliveredImage(image, reached, taken, depth, samples))

    def _sample(self, visitor: Client, pose: Pose, side: int, reached: int) -> SampleRequest:
        width, height = visitor.size(side, self.drawable.square_pixels)
        aspect = visitor.window[0] / max(visitor.window[1], 1)
        index = max(reached - LARGE - 1, 0)
        offset = resolution.offsets()[index] if reached > LARGE else (0.0, 0.0)
        pose = replace(pose, aspect=aspect)
        settled = reached >= LARGE
        return SampleRequest(pose, width, height, visitor.look, offset, index, settled, depth=visitor.depth)

    def _depth(self, visitor: Client, sampled: SampleResult, sample: SampleRequest) -> np.ndarray | None:
        if not visitor.depth or sampled.depth is None:
            return None
        depth = dr.select(sampled.depth > 0, sampled.depth, FAR) + dr.zeros(
            type(sampled.depth), sample.width * sample.height
        )
        return np.array(depth.numpy(), dtype=np.float32).reshape(sample.height, sample.width)


def added(sums: list[Any], planes: list[Any]) -> list[Any]:
    """Sums of planes, evaluated."""
    total = [a + b for a, b in zip(sums, planes, strict=True)] if sums else list(planes)
    dr.eval(total)
    return total
