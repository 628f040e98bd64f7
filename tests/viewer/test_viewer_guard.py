"""Access control of a page against viser's real server, by raw sockets: who may connect, what is read."""

from __future__ import annotations

import contextlib
import itertools
import math
import re
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mi_refgs  # noqa: F401  (first: it chooses the libLLVM that Dr.Jit loads)

# isort: split
import msgspec
import pytest
import viser
from viser import _messages
from websockets.asyncio import server as websockets_server
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from mi_refgs.data.dataset import read_dataset
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.viewer import guard as guard_module
from mi_refgs.viewer.guard import SIDE, TEXT, UPLOAD, VALUES, Guard, guard_controls, guarded
from mi_refgs.viewer.page import Page
from mi_refgs.viewer.reconstruction_view import ReconstructionView
from mi_refgs.viewer.serve import add_panels
from tests.helpers import refused
from tests.scenes.tiny import write_data

WAIT = 20.0
"""Seconds that a busy machine may take to answer."""


@pytest.fixture(scope="module")
def pages(scene: TrainedScene, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Page]]:
    """Pages with every panel, for this machine only and for others, too; nothing is drawn."""
    displayed = ReconstructionView(scene)
    with contextlib.ExitStack() as stack:
        found = {}
        for host in ("127.0.0.1", "0.0.0.0"):
            folder = tmp_path_factory.mktemp("page")
            data = {"test": read_dataset(write_data(folder / "data"), "test")}
            found[host] = Page(displayed, data, "a page", (host, 0), folder / "views")
            stack.callback(found[host].close)
            add_panels(found[host], displayed, scene)
        yield found


@pytest.fixture(scope="module")
def page(pages: dict[str, Page]) -> Page:
    return pages["127.0.0.1"]


def port_and_token(page: Page) -> tuple[int, str]:
    """Those of its address."""
    found = re.fullmatch(r"http://[^/]+:(\d+)/([0-9a-f]{32})/", page.url)
    assert found, page.url
    return int(found[1]), found[2]


# ---------------- requests ----------------

UPGRADE = (
    "Upgrade: websocket",
    "Connection: Upgrade",
    "Sec-WebSocket-Version: 13",
    "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==",
)
OWN_HOSTS = ("127.0.0.1:{port}", "localhost:{port}", "LOCALHOST:9000", "[::1]:{port}", "127.0.0.1")
FOREIGN_HOSTS = (
    "evil.example:{port}",
    "127.0.0.1.evil.example",
    "localhost@evil.example",
    "evil.example.",
    "[",
    "",
)
ADDRESS = "192.0.2.7:{port}"
"""A host that is this machine only where the page listens at every address: nobody can redirect it."""
OWN_ORIGINS = (None, "http://{host}", "https://{host}")
FOREIGN_ORIGINS = ("http://evil.example", "null", "http://{host}.evil.example", "http://127.0.0.1:1", "")
OWN_PATHS = ("/{token}", "/{token}/", "/{token}/?websocket=ws://127.0.0.1", "/{token}?a=b")
FOREIGN_PATHS = ("/", "/index.html", "/{token}0", "/{cut}", "/x/{token}", "//{token}", "/?{token}", "/\xe9")


def status(port: int, path: str, *headers: str) -> int:
    """The status of the answer to a request of these lines."""
    lines = [f"GET {path} HTTP/1.1", *headers, "", ""]
    with socket.create_connection(("127.0.0.1", port), timeout=WAIT) as raw:
        raw.sendall("\r\n".join(lines).encode("latin-1"))
        return int(raw.recv(64).split()[1])


@pytest.mark.parametrize("upgrade", [(), UPGRADE], ids=["page", "websocket"])
@pytest.mark.parametrize("listens_at", ["127.0.0.1", "0.0.0.0"])
def test_a_request_needs_host_origin_and_token_of_the_page(
    listens_at: str, upgrade: tuple[str, ...], pages: dict[str, Page]
) -> None:
    port, token = port_and_token(pages[listens_at])

    def answer(host: Any, origin: Any, path: Any, *more: str) -> int:
        host = host.format(port=port)
        origins = () if origin is None else (f"Origin: {origin.format(host=host.lower())}",)
        path = path.format(token=token, cut=token[:-1])
        return status(port, path, f"Host: {host}", *origins, *upgrade, *more)

    answered = 101 if upgrade else 200
    for parts in itertools.product(OWN_HOSTS, OWN_ORIGINS, OWN_PATHS):
        assert answer(*parts) == answered, parts
    host, origin, path = OWN_HOSTS[0], OWN_ORIGINS[1], OWN_PATHS[0]
    foreign: list[tuple[Any, ...]] = [(each, origin, path) for each in FOREIGN_HOSTS]
    foreign += [(host, each, path) for each in FOREIGN_ORIGINS]
    foreign += [(host, origin, each) for each in FOREIGN_PATHS]
    foreign += [(host, origin, path, f"{name}evil.example") for name in ("Host: ", "Origin: http://")]
    for request in foreign:
        assert answer(*request) == 403, request
    assert answer(ADDRESS, origin, path) == (403 if listens_at == "127.0.0.1" else answered)
    assert status(port, f"/{token}", *upgrade) == 403  # without any host


def test_every_page_has_its_own_token() -> None:
    tokens = {Guard("127.0.0.1").token for _ in range(20)}
    assert len(tokens) == 20 and {len(token) for token in tokens} == {32}


@pytest.mark.parametrize(
    "host, name",
    [("127.0.0.1",) * 2, ("::1", "[::1]"), ("::", socket.gethostname()), ("0.0.0.0", socket.gethostname())],
)
def test_the_address_opens_from_where_the_page_can_be_reached(host: str, name: str) -> None:
    guard = Guard(host)
    assert guard.url(8) == f"http://{name}:8/{guard.token}/"


# ---------------- messages ----------------

CAMERA: dict[str, Any] = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (0.0, 0.0, -3.0),
    "image_height": 400,
    "image_width": 600,
    "fov": 0.8,
    "near": 0.01,
    "far": 1000,
    "look_at": (0, 0, 0),
    "up_direction": (0, 0, 1),
}
HOSTILE: tuple[Any, ...] = (
    *(math.nan, math.inf, -math.inf, 1e300, -1e300, 2**63, -(2**62), -1, "1", "x" * (TEXT + 1), "é", b"x"),
    *(None, [], {}, [1.0], [math.nan] * 3, {"value": 1}, True, [[]] * 4),
)
"""Values of which a control, or a field of a message, takes none that is out of its range."""


def controls(page: Page) -> dict[str, Any]:
    """viser's handles by their ids."""
    found: dict[str, Any] = page.server.gui._gui_input_handle_from_uuid
    return found


def until(done: Callable[[], bool]) -> None:
    """Wait for a condition."""
    end = time.monotonic() + WAIT
    while not done():
        assert time.monotonic() < end
        time.sleep(0.002)


class Connection:
    """A connection as the page's script makes one, and its client on the page."""

    def __init__(self, page: Page) -> None:
        self.page, before = page, set(page.loop.clients)
        port, token = port_and_token(page)
        protocol: Any = f"viser-v{viser.__version__}"
        self.socket = connect(f"ws://127.0.0.1:{port}/{token}", subprotocols=[protocol], max_queue=None)
        self.send(**CAMERA)
        until(lambda: bool(set(page.loop.clients) - before))
        (self.number,) = set(page.loop.clients) - before
        self.upload = next(c for c in controls(page).values() if type(c).__name__ == UPLOAD)

    def send(self, **message: Any) -> None:
        self.socket.send(msgspec.msgpack.encode(message))

    def update(self, control: Any, value: Any) -> None:
        """Set a control, if the page allows it."""
        self.send(type="GuiUpdateMessage", uuid=control._impl.uuid, updates={"value": value})

    def settle(self) -> None:
        """Wait until all that was sent is read: messages are read in their order."""
        exposure = next(c for c in controls(self.page).values() if getattr(c, "label", "") == "Exposure")
        value = 1.0 if exposure.value != 1.0 else 2.0
        self.update(exposure, value)
        until(lambda: exposure.value == value)

    def start(self, transfer: str, size: int, parts: int, button: str | None = None) -> None:
        """Announce a file."""
        self.send(
            type="FileTransferStartUpload",
            source_component_uuid=self.upload._impl.uuid if button is None else button,
            **{"transfer_uuid": transfer, "filename": transfer, "mime_type": ""},
            **{"size_bytes": size, "part_count": parts},
        )

    def part(self, transfer: str, index: int, content: bytes) -> None:
        """Send a part of a file."""
        self.send(
            type="FileTransferPart",
            source_component_uuid=self.upload._impl.uuid,
            **{"transfer_uuid": transfer, "part_index": index, "content": content},
        )

    def received(self) -> dict[str, int]:
        """Bytes of unfinished files that viser keeps, by transfer."""
        self.settle()
        states = self.page.server.gui._current_file_upload_states
        return {name: sum(map(len, state["parts"].values())) for name, state in states.items()}


@pytest.fixture
def client(page: Page) -> Iterator[Connection]:
    """A connection that has sent its camera."""
    made = Connection(page)
    yield made
    made.socket.close()
    until(lambda: made.number not in page.loop.clients)


def in_range(control: Any) -> bool:
    """Whether a control has a value that its page offers."""
    value = control.value
    if hasattr(control, "options"):
        return value in control.options
    if hasattr(control, "min"):
        return bool(control.min <= value <= control.max)
    return isinstance(value, bool) or (isinstance(value, str) and len(value) <= TEXT)


def test_no_control_takes_a_value_that_the_page_does_not_offer(client: Connection) -> None:
    """Every control of every panel. A new class of controls has to be listed in VALUES."""
    everyone = [c for c in controls(client.page).values() if type(c).__name__ != UPLOAD]
    assert {type(control).__name__ for control in everyone} == set(VALUES)
    for control, value in itertools.product(everyone, HOSTILE):
        client.update(control, value)
    callbacks = [list(control._impl.update_cb) for control in everyone]
    for control in everyone:  # a property that is not its value
        updates = {"update_cb": [], "value": control.value}
        client.send(type="GuiUpdateMessage", uuid=control._impl.uuid, updates=updates)
    client.settle()
    assert [getattr(control, "label", "") for control in everyone if not in_range(control)] == []
    assert [control._impl.update_cb for control in everyone] == callbacks


def test_values_that_the_page_offers_are_taken(client: Connection) -> None:
    kinds = {type(control).__name__: control for control in controls(client.page).values()}
    wanted: dict[str, Any] = {
        "GuiTextHandle": "x < 0",
        "GuiDropdownHandle": "400²",
        "GuiCheckboxHandle": True,
    }
    for kind, value in wanted.items():
        client.update(kinds[kind], value)
        until(lambda control=kinds[kind], value=value: control.value == value)  # type: ignore[misc]
    client.update(kinds["GuiTextHandle"], "")
    client.settle()


def test_a_camera_out_of_range_is_dropped(client: Connection) -> None:
    looking = client.page.loop.clients[client.number]
    before = looking.pose, looking.window
    for field, value in itertools.product(set(CAMERA) - {"type"}, HOSTILE):
        client.send(**CAMERA | {field: value})
    for more in (
        *({"wxyz": (0, 0, 0, 0)}, {"position": (0, 0, math.nan)}, {"fov": 0}, {"fov": math.pi}),
        *({"image_height": 0}, {"image_width": SIDE + 1}, {"image_width": SIDE, "image_height": SIDE}),
    ):
        client.send(**CAMERA | more)
    client.settle()
    assert (looking.pose, looking.window) == before  # the same object: no other was made
    client.send(**CAMERA | {"fov": 0.7, "image_width": 7680, "image_height": 4320})
    until(lambda: looking.window == (7680, 4320))


GIZMO: dict[str, Any] = {
    "type": "TransformControlsUpdateMessage",
    **{"name": "/gizmo", "wxyz": (1, 0, 0, 0), "position": (1, 2, 3), "owner": ""},
}
CLICK: dict[str, Any] = {
    "type": "ScenePointerMessage",
    **{"event_type": "click", "modifier": "shift", "screen_pos": [(0.25, 0.5)]},
    **{"ray_origin": (0, 0, 0), "ray_direction": (0, 0, 1)},
}


def test_a_moved_gizmo_is_taken_unless_it_is_out_of_range(client: Connection) -> None:
    gizmo = client.page.server.scene.add_transform_controls("/gizmo", position=(0.0, 0.0, 0.0))
    for field, value in itertools.product(("name", "wxyz", "position"), HOSTILE):
        client.send(**GIZMO | {field: value})
    client.send(**GIZMO | {"wxyz": (0, 0, 0, 0)})
    client.settle()
    assert tuple(gizmo.position) == (0, 0, 0)
    client.send(**GIZMO)
    until(lambda: tuple(gizmo.position) == (1, 2, 3))
    gizmo.remove()


def test_a_click_and_a_rectangle_are_taken_unless_they_are_malformed(client: Connection) -> None:
    scene, taken = client.page.server.scene, list[Any]()
    scene.on_click(modifier="shift")(taken.append)
    scene.on_rect_select(modifier="shift")(taken.append)
    rectangle = CLICK | {"event_type": "rect-select", "ray_origin": None, "ray_direction": None}
    for field, value in itertools.product(set(CLICK) - {"type"}, HOSTILE):
        client.send(**CLICK | {field: value})
    for wrong in (
        *(CLICK | {"ray_origin": None}, CLICK | {"screen_pos": [(0, 0), (1, 1)]}, CLICK | {"screen_pos": []}),
        *(rectangle | {"screen_pos": [(0, 0)]}, rectangle | {"screen_pos": [(0, 0), (1, math.nan)]}),
        *(CLICK | {"event_type": "drag"}, CLICK | {"modifier": "alt"}),
    ):
        client.send(**wrong)
    client.settle()
    assert taken == []
    client.send(**CLICK)
    client.send(**rectangle | {"screen_pos": [(0.1, 0.2), (0.3, 0.4)]})
    until(lambda: len(taken) == 2)
    assert [*taken[0].screen_pos] == [0.25, 0.5] and [*taken[1].screen_max] == [0.3, 0.4]
    scene.remove_click_callback()
    scene.remove_rect_select_callback()


def test_bytes_that_are_no_message_are_dropped(client: Connection) -> None:
    nested = b"\x82\xa4type\xb0GuiUpdateMessage\xa7updates\x81\xa5value" + b"\x91" * 100_000
    for raw in (b"", b"\x80", b"\x93\x01", b"\xc1", nested, "text", msgspec.msgpack.encode([1])):
        client.socket.send(raw)
    client.settle()


def test_other_kinds_of_messages_do_not_reach_viser() -> None:
    """Some let viser open a tunnel to the internet, or send to other pages."""
    guard, taken = Guard("127.0.0.1"), set()
    for kind in _messages.Message.get_subclasses():
        for fields in (CAMERA, {"uuid": "1", "updates": {"value": True}}, {}):
            if guard.admits(None, msgspec.msgpack.encode(fields | {"type": kind.__name__})):
                taken.add(kind.__name__)
    assert taken == {"ViewerCameraMessage"}  # the others are of controls, of which this has none
    kinds: list[Any] = [guard_module.Update, guard_module.Start, guard_module.Part]
    kinds += [guard_module.Gizmo, guard_module.Pointer]
    tags = ["GuiUpdateMessage", "FileTransferStartUpload", "FileTransferPart"]
    tags += ["TransformControlsUpdateMessage", "ScenePointerMessage"]
    assert [kind.__struct_config__.tag for kind in kinds] == tags


# ---------------- uploads ----------------


def test_one_file_at_a_time_is_uploaded_within_its_bounds(
    client: Connection, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(guard_module, "UPLOAD_BYTES", 200_000)
    told: list[str] = []
    monkeypatch.setattr(client.page.guard, "refused", told.append)
    client.start("too large", 200_001, 4)
    assert (client.received(), len(told)) == ({}, 1) and "resize" in told[0]
    client.start("many parts", 100_000, 50)
    client.start("of no button", 100, 1, "nothing")
    client.start("negative", -5, 1)
    assert (client.received(), len(told)) == ({}, 1)
    client.start("file", 100_000, 2)
    client.start("second", 10, 1)
    assert (client.received(), len(told)) == ({"file": 0}, 2) and "another file" in told[1]
    client.part("file", 1, b"x" * 10)  # not its turn
    client.part("file", 0, b"x" * 100_001)
    client.part("second", 0, b"x" * 10)
    assert client.received() == {"file": 0}
    client.part("file", 0, b"x" * 60_000)
    client.part("file", 1, b"x" * 40_001)
    assert client.received() == {"file": 60_000}
    client.part("file", 1, b"y" * 40_000)
    assert client.received() == {}
    until(lambda: client.upload.value.content == b"x" * 60_000 + b"y" * 40_000)
    client.start("third", 10, 1)
    assert client.received() == {"third": 0}
    client.part("third", 0, b"x" * 10)
    assert client.received() == {}


def test_an_interrupted_upload_does_not_block_the_next(client: Connection) -> None:
    other = Connection(client.page)
    other.start("broken", 100, 1)
    assert other.received() == {"broken": 0}
    other.socket.close()
    until(lambda: client.received() == {})
    client.start("next", 10, 1)
    assert client.received() == {"next": 0}
    client.part("next", 0, b"x" * 10)
    assert client.received() == {}


def test_a_message_beyond_the_largest_ends_its_connection(client: Connection) -> None:
    other = Connection(client.page)
    with pytest.raises(ConnectionClosed) as closed:
        other.socket.send(b"x" * (guard_module.MESSAGE_BYTES + 1))
        while True:
            other.socket.recv(timeout=WAIT)
    assert closed.value.rcvd is not None and closed.value.rcvd.code == 1009


# ---------------- nothing is served without a guard ----------------


class Server:
    """A viser that does not use websockets' server."""

    stopped = 0

    def __init__(self, gui: object = None, **_: Any) -> None:
        self.gui = gui or SimpleNamespace(_gui_input_handle_from_uuid={})

    def stop(self) -> None:
        Server.stopped += 1


def test_a_viser_that_bypasses_the_guard_is_stopped(
    scene: TrainedScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(viser, "ViserServer", Server)
    before, words = Server.stopped, "does not let the page be protected; pip install viser=="
    refused(lambda: Page(ReconstructionView(scene), {}, "a page", ("127.0.0.1", 0), tmp_path), words)
    assert Server.stopped == before + 1


def test_a_viser_with_unknown_controls_is_stopped() -> None:
    guard, before = Guard("127.0.0.1"), Server.stopped
    guard.in_place = True
    refused(lambda: guard_controls(guard, Server(object())), "pip install viser==")
    assert Server.stopped == before + 1


def test_websockets_without_the_required_options_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(websockets_server, "serve", lambda handler, host, port, process_request=None: None)
    refused(lambda: guarded(Guard("127.0.0.1")).__enter__(), "pip install viser==")
