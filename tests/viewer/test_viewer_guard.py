"""Who may connect to a page and what it may send, against viser's real server by raw sockets."""

from __future__ import annotations

import contextlib
import itertools
import math
import re
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mi_refgs  # noqa: F401  (first: it chooses the libLLVM that Dr.Jit loads)

# isort: split
import mitsuba as mi
import msgspec
import pytest
import viser
from viser import _messages
from websockets.asyncio import server as websockets_server
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from mi_refgs.data.dataset import read_dataset
from mi_refgs.errors import InputError
from mi_refgs.viewer import guard as guard_module
from mi_refgs.viewer.guard import SIDE, TEXT, UPLOAD, VALUES, Guard
from mi_refgs.viewer.page import Page, Views
from mi_refgs.viewer.reconstruction_view import ReconstructionView
from mi_refgs.viewer.serve import add_panels
from tests.scenes.known import known_scene
from tests.scenes.tiny import write_data

WAIT = 20.0
"""Seconds that a busy machine may take to answer."""


@pytest.fixture(scope="module")
def fitted() -> ReconstructionView:
    """What the pages show."""
    mi.set_variant("llvm_ad_rgb")
    return ReconstructionView(known_scene())


@contextlib.contextmanager
def serving(fitted: ReconstructionView, host: str, folder: Path) -> Iterator[Page]:
    """A page with every panel, that nothing is drawn for."""
    views = Views(test=read_dataset(write_data(folder / "data"), "test"))
    page = Page(fitted, views, "a page", (host, 0), folder / "views")
    add_panels(page, fitted, fitted.scene)
    yield page
    page.close()


@pytest.fixture(scope="module")
def page(fitted: ReconstructionView, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """One for this machine only."""
    with serving(fitted, "127.0.0.1", tmp_path_factory.mktemp("page")) as page:
        yield page


@pytest.fixture(scope="module")
def open_page(fitted: ReconstructionView, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """One for other machines, too."""
    with serving(fitted, "0.0.0.0", tmp_path_factory.mktemp("open_page")) as page:
        yield page


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
@pytest.mark.parametrize("served", ["page", "open_page"])
def test_a_request_needs_host_origin_and_token_of_the_page(
    served: str, upgrade: tuple[str, ...], request: pytest.FixtureRequest
) -> None:
    page = request.getfixturevalue(served)
    port, token = port_and_token(page)

    def answer(host: Any, origin: Any, path: Any, *more: str) -> int:
        host = host.format(port=port)
        origins = () if origin is None else (f"Origin: {origin.format(host=host.lower())}",)
        path = path.format(token=token, cut=token[:-1])
        return status(port, path, f"Host: {host}", *origins, *upgrade, *more)

    answered = 101 if upgrade else 200
    for parts in itertools.product(OWN_HOSTS, OWN_ORIGINS, OWN_PATHS):
        assert answer(*parts) == answered, parts
    host, origin, path = OWN_HOSTS[0], OWN_ORIGINS[1], OWN_PATHS[0]
    for foreign in FOREIGN_HOSTS:
        assert answer(foreign, origin, path) == 403, foreign
    for foreign in FOREIGN_ORIGINS:
        assert answer(host, foreign, path) == 403, foreign
    for foreign in FOREIGN_PATHS:
        assert answer(host, origin, foreign) == 403, foreign
    assert answer(ADDRESS, origin, path) == (403 if served == "page" else answered)
    for second in ("Host: evil.example", "Origin: http://evil.example"):
        assert answer(host, origin, path, second) == 403
    assert status(port, f"/{token}", *upgrade) == 403  # without any host


def test_every_page_has_a_token_of_its_own() -> None:
    tokens = {Guard("127.0.0.1").token for _ in range(20)}
    assert len(tokens) == 20 and {len(token) for token in tokens} == {32}


@pytest.mark.parametrize(
    "host, begin",
    [
        ("127.0.0.1", "http://127.0.0.1:8/"),
        ("::1", "http://[::1]:8/"),
        ("::", f"http://{socket.gethostname()}:8/"),
        ("0.0.0.0", f"http://{socket.gethostname()}:8/"),
    ],
)
def test_the_address_opens_from_where_the_page_can_be_reached(host: str, begin: str) -> None:
    guard = Guard(host)
    assert guard.url(8) == f"{begin}{guard.token}/"


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


class Client:
    """A connection as the page's script makes one."""

    def __init__(self, page: Page) -> None:
        port, token = port_and_token(page)
        self.page = page
        self.connection: ClientConnection = connect(
            f"ws://127.0.0.1:{port}/{token}",
            subprotocols=[f"viser-v{viser.__version__}"],  # type: ignore[list-item]
            max_queue=None,
        )
        self.number = max(set(page.loop.clients), default=-1)

    def send(self, **message: Any) -> None:
        """Send a message."""
        self.connection.send(msgspec.msgpack.encode(message))

    def update(self, control: Any, value: Any) -> None:
        """Set a control, as far as the page lets it be set."""
        self.send(type="GuiUpdateMessage", uuid=control._impl.uuid, updates={"value": value})

    def settled(self) -> None:
        """Wait until all that was sent is read: messages are read in their order."""
        exposure = next(c for c in controls(self.page).values() if getattr(c, "label", "") == "Exposure")
        value = 1.0 if exposure.value != 1.0 else 2.0
        self.update(exposure, value)
        until(lambda: exposure.value == value)


def controls(page: Page) -> dict[str, Any]:
    """viser's handles by their ids."""
    found: dict[str, Any] = page.server.gui._gui_input_handle_from_uuid
    return found


def until(done: Callable[[], bool]) -> None:
    """Wait for it."""
    end = time.monotonic() + WAIT
    while not done():
        assert time.monotonic() < end
        time.sleep(0.002)


@pytest.fixture
def client(page: Page) -> Iterator[Client]:
    """One that looks at the page."""
    before = set(page.loop.clients)
    made = Client(page)
    made.send(**CAMERA)
    until(lambda: bool(set(page.loop.clients) - before))
    (made.number,) = set(page.loop.clients) - before
    yield made
    made.connection.close()
    until(lambda: made.number not in page.loop.clients)


def in_range(control: Any) -> bool:
    """Whether a control has a value that its page offers."""
    value = control.value
    if hasattr(control, "options"):
        return value in control.options
    if hasattr(control, "min"):
        return bool(control.min <= value <= control.max)
    return isinstance(value, bool) or (isinstance(value, str) and len(value) <= TEXT)


def test_no_control_takes_a_value_that_the_page_does_not_offer(client: Client) -> None:
    """Every control of every panel. A kind of control that is new has to be listed."""
    everyone = [c for c in controls(client.page).values() if type(c).__name__ != UPLOAD]
    assert {type(control).__name__ for control in everyone} == set(VALUES)
    for control, value in itertools.product(everyone, HOSTILE):
        client.update(control, value)
    callbacks = [list(control._impl.update_cb) for control in everyone]
    for control in everyone:  # a property that is not its value
        updates = {"update_cb": [], "value": control.value}
        client.send(type="GuiUpdateMessage", uuid=control._impl.uuid, updates=updates)
    client.settled()
    assert [getattr(control, "label", "") for control in everyone if not in_range(control)] == []
    assert [control._impl.update_cb for control in everyone] == callbacks


def test_what_the_page_offers_is_taken(client: Client) -> None:
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
    client.settled()


def test_a_camera_without_sense_moves_nothing(client: Client) -> None:
    visitor = client.page.loop.clients[client.number]
    before = visitor.pose, visitor.window
    for field, value in itertools.product(set(CAMERA) - {"type"}, HOSTILE):
        client.send(**CAMERA | {field: value})
    for more in (
        {"wxyz": (0, 0, 0, 0)},
        {"position": (0, 0, math.nan)},
        {"fov": 0},
        {"fov": math.pi},
        {"image_height": 0},
        {"image_width": SIDE + 1},
        {"image_width": SIDE, "image_height": SIDE},
    ):
        client.send(**CAMERA | more)
    client.settled()
    assert (visitor.pose, visitor.window) == before  # the same object: no other was made
    client.send(**CAMERA | {"fov": 0.7, "image_width": 7680, "image_height": 4320})
    until(lambda: visitor.window == (7680, 4320))


def test_what_is_no_message_is_dropped_and_the_page_goes_on(client: Client) -> None:
    nested = b"\x82\xa4type\xb0GuiUpdateMessage\xa7updates\x81\xa5value" + b"\x91" * 100_000
    for raw in (b"", b"\x80", b"\x93\x01", b"\xc1", nested, "text", msgspec.msgpack.encode([1])):
        client.connection.send(raw)
    client.settled()


def test_no_message_of_another_kind_reaches_viser(page: Page) -> None:
    """Some make viser open a tunnel to the internet, or talk to other pages."""
    guard, taken = Guard("127.0.0.1"), set()
    for kind in _messages.Message.get_subclasses():
        for fields in (CAMERA, {"uuid": "1", "updates": {"value": True}}, {}):
            if guard.admits(None, msgspec.msgpack.encode(fields | {"type": kind.__name__})):
                taken.add(kind.__name__)
    assert taken == {"ViewerCameraMessage"}  # the others are of controls, of which this has none
    kinds = {
        kind.__struct_config__.tag for kind in (guard_module.Update, guard_module.Start, guard_module.Part)
    }
    assert kinds == {"GuiUpdateMessage", "FileTransferStartUpload", "FileTransferPart"}


# ---------------- uploads ----------------


class Sender:
    """A client that uploads."""

    def __init__(self, client: Client) -> None:
        self.client = client
        self.button = next(c for c in controls(client.page).values() if type(c).__name__ == UPLOAD)

    def start(self, transfer: str, size: int, parts: int, button: str | None = None) -> None:
        """Announce a file."""
        self.client.send(
            type="FileTransferStartUpload",
            source_component_uuid=self.button._impl.uuid if button is None else button,
            transfer_uuid=transfer,
            filename=transfer,
            mime_type="",
            size_bytes=size,
            part_count=parts,
        )

    def part(self, transfer: str, index: int, content: bytes) -> None:
        """Send a part of it."""
        self.client.send(
            type="FileTransferPart",
            source_component_uuid=self.button._impl.uuid,
            transfer_uuid=transfer,
            part_index=index,
            content=content,
        )

    def held(self) -> dict[str, int]:
        """Bytes that viser keeps, by transfer."""
        self.client.settled()
        states = self.client.page.server.gui._current_file_upload_states
        return {name: sum(map(len, state["parts"].values())) for name, state in states.items()}


def test_a_file_is_uploaded_within_its_bounds_one_at_a_time(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(guard_module, "UPLOAD_BYTES", 200_000)
    told: list[str] = []
    monkeypatch.setattr(client.page.guard, "refused", told.append)
    sender = Sender(client)
    sender.start("too large", 200_001, 4)
    assert (sender.held(), len(told)) == ({}, 1) and "resize" in told[0]
    sender.start("many parts", 100_000, 50)
    sender.start("of no button", 100, 1, "nothing")
    sender.start("negative", -5, 1)
    assert (sender.held(), len(told)) == ({}, 1)
    sender.start("file", 100_000, 2)
    sender.start("second", 10, 1)
    assert (sender.held(), len(told)) == ({"file": 0}, 2) and "another file" in told[1]
    sender.part("file", 1, b"x" * 10)  # not its turn
    sender.part("file", 0, b"x" * 100_001)
    sender.part("second", 0, b"x" * 10)
    assert sender.held() == {"file": 0}
    sender.part("file", 0, b"x" * 60_000)
    sender.part("file", 1, b"x" * 40_001)
    assert sender.held() == {"file": 60_000}
    sender.part("file", 1, b"y" * 40_000)
    assert sender.held() == {}
    until(lambda: sender.button.value.content == b"x" * 60_000 + b"y" * 40_000)
    sender.start("third", 10, 1)
    assert sender.held() == {"third": 0}
    sender.part("third", 0, b"x" * 10)
    assert sender.held() == {}


def test_an_upload_that_was_broken_off_leaves_room_for_the_next(client: Client) -> None:
    other = Client(client.page)
    other.send(**CAMERA)
    Sender(other).start("broken", 100, 1)
    assert Sender(other).held() == {"broken": 0}
    other.connection.close()
    sender = Sender(client)
    until(lambda: sender.held() == {})
    sender.start("next", 10, 1)
    assert sender.held() == {"next": 0}
    sender.part("next", 0, b"x" * 10)
    assert sender.held() == {}


def test_a_message_beyond_the_largest_ends_its_connection(client: Client) -> None:
    other = Client(client.page)
    with pytest.raises(ConnectionClosed) as closed:
        other.connection.send(b"x" * (guard_module.MESSAGE_BYTES + 1))
        while True:
            other.connection.recv(timeout=WAIT)
    assert closed.value.rcvd is not None and closed.value.rcvd.code == 1009


# ---------------- without a guard nothing is served ----------------


def test_a_viser_that_goes_past_the_guard_is_stopped(
    fitted: ReconstructionView, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stopped = []

    class Other:
        def __init__(self, **_: Any) -> None:
            self.gui = type("Gui", (), {"_gui_input_handle_from_uuid": {}})()

        def stop(self) -> None:
            stopped.append(self)

    monkeypatch.setattr(viser, "ViserServer", Other)
    with pytest.raises(InputError, match="does not let the page be protected; pip install viser=="):
        Page(fitted, Views(), "a page", ("127.0.0.1", 0), tmp_path)
    assert len(stopped) == 1


def test_a_viser_without_known_controls_is_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    class Server:
        gui, stopped = object(), False

        def stop(self) -> None:
            self.stopped = True

    guard, server = Guard("127.0.0.1"), Server()
    guard.in_place = True
    with pytest.raises(InputError, match="pip install viser=="):
        guard_module.guard_controls(guard, server)
    assert server.stopped


def test_websockets_without_the_places_of_the_guard_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(websockets_server, "serve", lambda handler, host, port, process_request=None: None)
    with pytest.raises(InputError, match="pip install viser=="), guard_module.guarded(Guard("127.0.0.1")):
        pass
