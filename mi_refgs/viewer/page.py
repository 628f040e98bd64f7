"""The page: a viser server whose background is drawn by a `RenderLoop`, and the controls beside it."""

from __future__ import annotations

import contextlib
import errno
import io
import math
import socket
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.data.dataset import Dataset
from mi_refgs.errors import InputError
from mi_refgs.viewer import resolution
from mi_refgs.viewer.loop import Client, DeliveredImage, RenderLoop
from mi_refgs.viewer.pose import Pose, up_of
from mi_refgs.viewer.tonemap import DisplayOptions
from mi_refgs.viewer.viewer_scene import ViewerScene

MOVING_JPEG, STILL_JPEG = 70, 92
"""JPEG qualities of pictures that are soon replaced, and of those that stay until a smooth one, a PNG."""
STATUS_INTERVAL = 0.5
"""Seconds between updates of the line that says what is shown."""
START_DISTANCE = 2.5
"""Distance of the first camera without a data set, in radii of the object."""
START_FOV = math.radians(40)
"""Its vertical field of view."""
ERROR_SECONDS = 8.0
"""That a message about bad input stays on the page."""


@dataclass(frozen=True)
class Views:
    """The pictures that a scene was fitted to, as far as they are there."""

    train: Dataset | None = None
    test: Dataset | None = None

    @property
    def all(self) -> list[Any]:
        """Every view, of the test split first."""
        return [view for split in (self.test, self.train) if split is not None for view in split.views]


def require_viser() -> Any:
    """viser; raises InputError that says how to install it."""
    try:
        import viser
    except ImportError:
        raise InputError('view: viser is not installed; pip install "mi_refgs[view]"') from None
    return viser


def require_free(host: str, port: int) -> None:
    """Raise InputError unless a server can listen there: viser itself would take another port."""
    if not 0 <= port <= 65535:
        raise InputError(f"--port: {port} is out of range; give 1 to 65535, or 0 for any that is free")
    try:
        info = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"--host: {host} is no address ({reason}); give another --host") from error
    try:
        with socket.socket(info[0], socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(info[4])
    except OSError as error:
        option = "host" if error.errno == errno.EADDRNOTAVAIL else "port"
        raise InputError(
            f"--{option}: {host}:{port} cannot be used ({error.strerror}); give another --{option}"
        ) from error


class Page:
    """One server for all pages that are open; its controls are shared, cameras are each page's own."""

    def __init__(
        self,
        drawable: ViewerScene,
        views: Views,
        title: str,
        host: str,
        port: int,
        views_folder: Path,
        begin: Pose | None = None,
    ) -> None:
        """Listen; raises InputError if that port is taken or viser is not installed."""
        viser = require_viser()
        from mi_refgs.viewer.guard import Guard, guard_controls, guarded  # needs what viser installs

        require_free(host, port)
        self.drawable, self.views, self.views_folder = drawable, views, views_folder
        self.begin = begin
        self.loop = RenderLoop(drawable)
        self.loop.failed = self.complain
        self.look = DisplayOptions(backdrop=drawable.backdrops[0], depths=self._depths())
        self.fixed: int | None = None
        self.largest = resolution.FINEST
        self.depth = False
        self.side = resolution.COARSEST
        self.status: Callable[[str], None] = lambda text: None
        self.looked: Callable[[], None] = lambda: None  # `look` has changed
        self.moved: Callable[[int, Pose], None] = lambda number, pose: None
        self._told = 0.0
        # A picture for a page that is closed meanwhile is nothing to tell of.
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection", UserWarning)
        self.guard = Guard(host)
        with guarded(self.guard), contextlib.redirect_stdout(io.StringIO()):  # viser greets
            self.server = viser.ViserServer(host=host, port=port, label=title, verbose=False)
        guard_controls(self.guard, self.server)
        self.guard.refused = self.complain
        if port and self.server.get_port() != port:
            self.server.stop()
            raise InputError(f"--port: {host}:{port} is in use; give another --port")
        self.url = self.guard.url(self.server.get_port())
        self.server.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True)
        self.server.gui.main_panel.dock_right()
        self.server.scene.set_up_direction(tuple(up_of(views.all)))
        self._set_start()

    # ---------------- cameras ----------------

    def start(self) -> Pose:
        """Where a page first looks from: as it was told, the first test view, or a little from above."""
        if self.begin is not None:
            return self.begin
        if self.views.all:
            return Pose.of_view(self.views.all[0])
        outward = np.array([math.cos(0.6), math.sin(0.6), 0.5])
        outward /= np.linalg.norm(outward)
        distance = START_DISTANCE * self.drawable.radius / math.tan(START_FOV / 2) / 2
        return looking(self.drawable.centre + distance * outward, self.drawable.centre, START_FOV)

    def _set_start(self) -> None:
        pose, camera = self.start(), self.server.initial_camera
        camera.position = pose.position
        camera.look_at = pose.look_at(self.drawable.centre)
        camera.up = pose.up if abs(pose.forward @ up_of(self.views.all)) > 0.99 else up_of(self.views.all)
        camera.fov = pose.fov
        camera.near, camera.far = 1e-3 * self.drawable.radius, 1e3 * self.drawable.radius

    def _depths(self) -> tuple[float, float]:
        """Distances that a depth map shows as white and as black: the object's, from the first camera."""
        distance = float(np.linalg.norm(self.start().position - self.drawable.centre))
        return max(distance - self.drawable.radius, 0.0), distance + self.drawable.radius

    def go(self, client: Any, pose: Pose) -> None:
        """Move a page's camera."""
        with client.atomic():
            client.camera.up_direction = up_of(self.views.all)
            client.camera.position = pose.position
            client.camera.look_at = pose.look_at(self.drawable.centre)
            client.camera.fov = pose.fov
        client.flush()

    # ---------------- pages ----------------

    def listen(self) -> None:
        """Let pages in."""
        self.server.on_client_connect(self._connected)
        self.server.on_client_disconnect(self._left)

    async def _connected(self, client: Any) -> None:
        visitor = Client(lambda shown: self._deliver(client, shown))
        visitor.look, visitor.fixed, visitor.largest = self.look, self.fixed, self.largest
        visitor.depth, visitor.side = self.depth, self.side
        self.loop.enter(client.client_id, visitor)

        async def moved(camera: Any) -> None:
            self._looks(client.client_id, camera)

        client.camera.on_update(moved)
        self._looks(client.client_id, client.camera)

    async def _left(self, client: Any) -> None:
        self.loop.leave(client.client_id)

    def _looks(self, number: int, camera: Any) -> None:
        window = (camera.image_width, camera.image_height)
        near = self.views.all[0].near if self.views.all else 0.0
        pose = Pose.of_page(camera.wxyz, camera.position, camera.fov, window[0] / window[1], near)
        self.moved(number, pose)
        self.loop.look(number, pose, window)

    def _deliver(self, client: Any, shown: DeliveredImage) -> None:
        smooth = shown.shown == resolution.DONE
        client.scene.set_background_image(
            shown.image,
            format="png" if smooth else "jpeg",
            jpeg_quality=MOVING_JPEG if shown.shown == resolution.COARSE else STILL_JPEG,
            depth=shown.depth,
        )
        client.flush()
        now = time.monotonic()
        if smooth or now - self._told > STATUS_INTERVAL:
            self._told = now
            height, width = shown.image.shape[:2]
            samples = shown.samples
            self.status(f"{width} × {height}, {samples} a pixel, {1000 * shown.seconds:.0f} ms")

    def close(self) -> None:
        """Stop listening."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    # ---------------- what controls use ----------------

    def set(self, **fields: Any) -> None:
        """Set what every page displays: `fixed`, `largest`, `depth` or fields of `DisplayOptions`."""
        own = {name: value for name, value in fields.items() if name in ("fixed", "largest", "depth")}
        for name, value in own.items():
            setattr(self, name, value)
        self.look = replace(self.look, **{n: v for n, v in fields.items() if n not in own})
        self.loop.change(**own, look=self.look)
        self.looked()

    def complain(self, message: str) -> None:
        """Show a sentence about bad input, or about what failed."""
        self.notify("Not done", message, "red")

    def notify(self, title: str, body: str, colour: str | None = None) -> None:
        """Show a message on every open page."""
        for client in self.server.get_clients().values():
            client.add_notification(title, body, auto_close_seconds=ERROR_SECONDS, color=colour)


def looking(position: np.ndarray, centre: np.ndarray, fov: float) -> Pose:
    """A pose that looks at a centre, z up."""
    forward = (centre - position) / np.linalg.norm(centre - position)
    left = np.cross([0.0, 0.0, 1.0], forward)
    left /= np.linalg.norm(left)
    matrix = np.eye(4)
    matrix[:3, :] = np.stack([left, np.cross(forward, left), forward, position], axis=1)
    return Pose(matrix, fov, 1.0)
