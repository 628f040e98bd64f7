"""The page: a viser server whose background image is drawn by a `RenderLoop`."""

import contextlib
import errno
import io
import math
import socket
import time
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.data.dataset import Dataset
from mi_refgs.errors import InputError, require_package
from mi_refgs.formats.orbits import FIELD_OF_VIEW, shots_around
from mi_refgs.viewer.loop import Client, RenderLoop
from mi_refgs.viewer.pose import Pose, up_of
from mi_refgs.viewer.reconstruction_view import ReconstructionView
from mi_refgs.viewer.resolution import COARSE, COARSEST, DONE

STATUS_INTERVAL = 0.5  # seconds between updates of the status line


def require_free(host: str, port: int) -> None:
    """Raise InputError unless a server can listen there: viser would silently take another port."""
    try:
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
    except (OSError, OverflowError) as error:
        is_host = isinstance(error, socket.gaierror) or getattr(error, "errno", 0) == errno.EADDRNOTAVAIL
        option = "--host" if is_host else "--port"
        what = f"{host}:{port} cannot be used ({getattr(error, 'strerror', None) or error})"
        raise InputError(what, option, remedy=f"give another {option}") from error


class Page:
    """One server for all open pages: they share its controls, and each has its own camera."""

    def __init__(
        self,
        scene: ReconstructionView,
        data: Mapping[str, Dataset],  # the available splits: "train", "test"
        title: str,
        address: tuple[str, int],  # host and port
        views_folder: Path,
    ) -> None:
        """Listen; raises InputError if the port is taken or viser is not installed."""
        viser = require_package("viser", "view", "view")
        from mi_refgs.viewer.guard import guarded  # needs what viser installs

        host, port = address
        require_free(host, port)
        self.scene, self.data, self.views_folder = scene, data, views_folder
        self.views = [view for split in ("test", "train") if split in data for view in data[split].views]
        self.up = up_of(self.views)
        self.loop = RenderLoop(scene)
        self.loop.report = lambda message: self.notify("Not done", message, "red")
        self.moving_side = COARSEST  # first resolution level of a client during motion
        self.status: Callable[[str], None] = lambda text: None  # set by a panel
        self._told = 0.0  # time of the last status
        # An image for a page that has been closed meanwhile is no problem.
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection", UserWarning)
        with guarded(host), contextlib.redirect_stdout(io.StringIO()):  # viser prints a banner
            self.server = viser.ViserServer(host=host, port=port, label=title, verbose=False)
        shown = socket.gethostname() if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
        self.url = f"http://{shown}:{self.server.get_port()}/"
        self.server.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True)
        self.server.gui.main_panel.dock_right()
        pose, camera, up = self.start(), self.server.initial_camera, self.up
        self.server.scene.set_up_direction(tuple(up))
        camera.position, camera.look_at = pose.position, pose.look_at(self.scene.centre)
        camera.up = pose.to_world[:3, 1] if abs(pose.forward @ up) > 0.99 else up
        camera.fov, camera.near, camera.far = pose.fov, 1e-3 * self.scene.radius, 1e3 * self.scene.radius

    def start(self) -> Pose:
        """Return the initial pose: the first test view, or where `refgs render` is without a data set."""
        if self.views:
            return Pose.of_view(self.views[0])
        camera = shots_around(self.scene.original.surfels)[0].camera
        return Pose(camera.pose(), math.radians(FIELD_OF_VIEW), 1.0)

    def go(self, client: Any, pose: Pose) -> None:
        """Move the camera of a page, a client of viser."""
        with client.atomic():
            client.camera.up_direction = self.up
            client.camera.position = pose.position
            client.camera.look_at = pose.look_at(self.scene.centre)
            client.camera.fov = pose.fov
        client.flush()

    async def connected(self, client: Any) -> None:
        """Display the scene on a page that has been opened."""
        self.loop.clients[client.client_id] = Client(partial(self._deliver, client), side=self.moving_side)
        near = self.views[0].near if self.views else 0.0

        async def moved(camera: Any) -> None:
            window = (camera.image_width, camera.image_height)
            self.loop.change(client.client_id, pose=Pose.of_page(camera, near), window=window)

        client.camera.on_update(moved)
        await moved(client.camera)

    def _deliver(self, client: Any, image: np.ndarray, progress: int, seconds: float) -> None:
        form, quality = "png" if progress == DONE else "jpeg", 70 if progress == COARSE else 92
        client.scene.set_background_image(image, format=form, jpeg_quality=quality)
        client.flush()
        now = time.monotonic()
        if progress == DONE or now - self._told > STATUS_INTERVAL:
            self._told = now
            height, width = image.shape[:2]
            samples = max(progress - COARSE, 1)
            self.status(f"{width} × {height}, {samples} per pixel, {1000 * seconds:.0f} ms")

    def close(self) -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def notify(self, title: str, body: str, colour: str | None = None) -> None:
        """Display a message on every open page for 8 seconds."""
        for client in self.server.get_clients().values():
            client.add_notification(title, body, auto_close_seconds=8.0, color=colour)
