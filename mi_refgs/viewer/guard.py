"""Access control of a page: which requests viser's server answers, and which messages it reads.

viser checks neither. Every request requires the page's host name and origin and a random token, the first
part of the address's path: a path is sent to this server only, a cookie to all ports of a host. Messages must
be of a kind that the page's own script sends, with numbers in range; others are dropped.
"""

from __future__ import annotations

import contextlib
import hmac
import inspect
import ipaddress
import math
import secrets
import socket
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from http import HTTPStatus
from typing import Annotated, Any, Literal
from urllib.parse import urlsplit

import msgspec
from websockets.asyncio import server as websockets_server
from websockets.http11 import Request
from websockets.protocol import State

from mi_refgs.errors import InputError

LOOPBACK = ("localhost", "127.0.0.1", "::1")
"""Names of this machine that only it can use."""
WILDCARDS = ("0.0.0.0", "::", "")
"""Hosts that listen at every address of this machine."""
UNPROTECTED = (
    "view: the installed viser or websockets does not let the page be protected; "
    "pip install viser==1.1.1 websockets==16.1.1"
)

MESSAGE_BYTES, PART_BYTES = 2**20, 2**16
"""Largest message, and smallest mean part of a file: viser's script sends parts of 2^19 bytes."""
UPLOAD_BYTES = 2**28
"""Largest file: more than an HDRI of 8,192 × 4,096 pixels takes as half-float RGB, uncompressed."""
PIXELS, SIDE = 2**25, 2**14
"""Largest window: an 8K display's, in any shape."""
COORDINATE = 1e9
"""Largest coordinate, scene units: its square is finite in float32."""
TEXT = 1000
"""Characters of a text field, and of a file's name."""

Coordinate = Annotated[float, msgspec.Meta(ge=-COORDINATE, le=COORDINATE)]
Distance = Annotated[float, msgspec.Meta(ge=0, le=COORDINATE)]
Point = tuple[Coordinate, Coordinate, Coordinate]
Quaternion = tuple[Coordinate, Coordinate, Coordinate, Coordinate]
Side = Annotated[int, msgspec.Meta(ge=1, le=SIDE)]
Text = Annotated[str, msgspec.Meta(max_length=TEXT)]
Count = Annotated[int, msgspec.Meta(ge=0)]


class Camera(msgspec.Struct, tag_field="type", tag="ViewerCameraMessage"):
    """The camera of a page."""

    wxyz: Quaternion
    position: Point
    look_at: Point
    up_direction: Point
    fov: Annotated[float, msgspec.Meta(ge=1e-3, le=math.pi - 1e-3)]  # vertical, radians
    near: Distance
    far: Distance
    image_width: Side
    image_height: Side


class Value(msgspec.Struct, forbid_unknown_fields=True):
    """The only property of a control that a page may set."""

    value: bool | float | Text


class Update(msgspec.Struct, tag_field="type", tag="GuiUpdateMessage"):
    """A new value of a control."""

    uuid: str
    updates: Value


class Start(msgspec.Struct, tag_field="type", tag="FileTransferStartUpload"):
    """The announcement of a file."""

    source_component_uuid: str
    transfer_uuid: Text
    filename: Text
    mime_type: Text
    size_bytes: Count
    part_count: Count


class Part(msgspec.Struct, tag_field="type", tag="FileTransferPart"):
    """A part of a file."""

    source_component_uuid: str
    transfer_uuid: str
    part_index: int
    content: bytes


class Gizmo(msgspec.Struct, tag_field="type", tag="TransformControlsUpdateMessage"):
    """A pose to which a gizmo of the page was moved."""

    name: Text
    wxyz: Quaternion
    position: Point
    owner: Text = ""


class Pointer(msgspec.Struct, tag_field="type", tag="ScenePointerMessage"):
    """A click or a dragged rectangle, with a key for which viser's server has a function."""

    event_type: Literal["click", "rect-select"]
    screen_pos: list[tuple[Coordinate, Coordinate]]  # a point, or two corners; 0 … 1 on the canvas
    modifier: Literal["shift", "cmd/ctrl"]
    ray_origin: Point | None = None  # of a click
    ray_direction: Point | None = None


DECODER = msgspec.msgpack.Decoder(Camera | Update | Start | Part | Gizmo | Pointer)
VALUES: dict[str, Callable[[Any, Any], bool]] = {
    "GuiButtonHandle": lambda control, value: isinstance(value, bool),
    "GuiButtonGroupHandle": lambda control, value: value in control.options,
    "GuiCheckboxHandle": lambda control, value: isinstance(value, bool),
    "GuiDropdownHandle": lambda control, value: value in control.options,
    "GuiSliderHandle": lambda control, value: (
        isinstance(value, float) and control.min <= value <= control.max
    ),
    "GuiTextHandle": lambda control, value: isinstance(value, str),
}
"""Whether a page may set a control to a value, by viser's class of the control; no other class may be set."""
UPLOAD = "GuiUploadButtonHandle"


@dataclass(eq=False)
class Upload:
    """A file on its way."""

    connection: Any
    transfer: str
    parts: int  # that are to come, in order
    bytes_left: int
    next_part: int = 0


class Guard:
    """The requests that a page answers, and the messages that it reads."""

    def __init__(self, host: str) -> None:
        """Guard a server that listens at `host`."""
        self.host = host.lower()
        self.token = secrets.token_hex(16)
        self.in_place = False  # whether viser's server uses it
        self.controls: Mapping[str, Any] = {}  # viser's handles by id
        self.refused: Callable[[str], None] = lambda reason: None  # called with why a file is refused
        self._upload: Upload | None = None

    def url(self, port: int) -> str:
        """Return the address that opens the page."""
        host = socket.gethostname() if self.host in WILDCARDS else self.host
        return f"http://{f'[{host}]' if ':' in host else host}:{port}/{self.token}/"

    # ---------------- requests ----------------

    def refusal(self, request: Request) -> str | None:
        """Return why a request is refused, one sentence; None for one that is answered."""
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        if len(hosts) != 1 or not self._is_own(hosts[0]):
            return "This server answers to its own host name only: open the address that the terminal shows."
        own = [f"{scheme}://{hosts[0]}".lower() for scheme in ("http", "https")]
        if any(origin.lower() not in own for origin in origins):
            return "Pages of other sites may not use this server."
        if not hmac.compare_digest(split(request.path)[0].encode(errors="replace"), self.token.encode()):
            return "The token is missing: open the address that the terminal shows."
        return None

    def _is_own(self, host: str) -> bool:
        """Whether a Host header names this server; the owner of a foreign name may resolve it to here."""
        with contextlib.suppress(ValueError):
            name = urlsplit(f"//{host}").hostname or ""
            if name in LOOPBACK or name == self.host:
                return True
            if self.host not in LOOPBACK:
                return name == socket.gethostname().lower() or bool(ipaddress.ip_address(name))
        return False

    # ---------------- messages ----------------

    def admits(self, connection: Any, raw: object) -> bool:
        """Whether viser may read a message of a connection."""
        try:
            message = DECODER.decode(raw) if isinstance(raw, bytes) else None
        except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError):
            return False
        match message:
            case Camera():
                return is_rotation(message.wxyz) and message.image_width * message.image_height <= PIXELS
            case Gizmo():
                return is_rotation(message.wxyz)
            case Pointer(event_type="click"):
                is_ray = message.ray_origin is not None and message.ray_direction is not None
                return is_ray and len(message.screen_pos) == 1
            case Pointer():
                return len(message.screen_pos) == 2
            case Update():
                control = self.controls.get(message.uuid)
                allowed = VALUES.get(type(control).__name__)
                return allowed is not None and allowed(control, message.updates.value)
            case Start():
                return self._may_start(connection, message)
            case Part():
                return self._may_continue(message)
        return False

    def _may_start(self, connection: Any, start: Start) -> bool:
        """Whether an upload may begin: one at a time on all pages, which bounds memory, too."""
        if type(self.controls.get(start.source_component_uuid)).__name__ != UPLOAD:
            return False
        if start.size_bytes > UPLOAD_BYTES:
            self.refused(f"the file is larger than {UPLOAD_BYTES >> 20} MB; resize it")
            return False
        if self._upload is not None and self._upload.connection.state is not State.CLOSED:
            self.refused("another file is being uploaded; wait for it, or close its page")
            return False
        if start.part_count > 1 + start.size_bytes // PART_BYTES:
            return False
        if start.part_count:
            self._upload = Upload(connection, start.transfer_uuid, start.part_count, start.size_bytes)
        return True

    def _may_continue(self, part: Part) -> bool:
        upload = self._upload
        if upload is None or (part.transfer_uuid, part.part_index) != (upload.transfer, upload.next_part):
            return False
        if len(part.content) > upload.bytes_left:
            return False
        upload.bytes_left -= len(part.content)
        upload.next_part += 1
        if upload.next_part == upload.parts:
            self._upload = None
        return True


def is_rotation(wxyz: Quaternion) -> bool:
    """Whether a quaternion can be normalised to a rotation."""
    return 0.5 < math.hypot(*wxyz) < 2


def split(path: str) -> tuple[str, str]:
    """Return the first part of a path, and the rest as a path."""
    first, _, rest = path.removeprefix("/").partition("/")
    first, mark, query = first.partition("?")
    return first, f"/{rest}{mark}{query}"


@contextlib.contextmanager
def guarded(guard: Guard) -> Iterator[None]:
    """Let the WebSocket server that is created inside pass requests and messages through a guard.

    Raises InputError if the installed websockets has no such interface: nothing is served unguarded.
    """
    original = websockets_server.serve
    offered = inspect.signature(original).parameters
    if not all(name in offered for name in ("process_request", "create_connection", "max_size")):
        raise InputError(UNPROTECTED)

    class Connection(websockets_server.ServerConnection):
        async def recv(self, *arguments: Any, **options: Any) -> Any:
            while not guard.admits(self, message := await super().recv(*arguments, **options)):
                pass
            return message

    def serve(*arguments: Any, process_request: Any = None, **options: Any) -> Any:
        def check(connection: Any, request: Request) -> Any:
            if (reason := guard.refusal(request)) is not None:
                return connection.respond(HTTPStatus.FORBIDDEN, f"{reason}\n")
            inner = replace(request, path=split(request.path)[1])
            return None if process_request is None else process_request(connection, inner)

        options |= {"max_size": MESSAGE_BYTES, "create_connection": Connection, "process_request": check}
        guard.in_place = True
        return original(*arguments, **options)

    websockets_server.serve = serve  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        websockets_server.serve = original  # type: ignore[misc]


def guard_controls(guard: Guard, server: Any) -> None:
    """Let pages use the controls of viser's server; stop an unguarded one and raise InputError."""
    controls: dict[str, Any] | None = getattr(server.gui, "_gui_input_handle_from_uuid", None)
    if not guard.in_place or controls is None:
        server.stop()
        raise InputError(UNPROTECTED)
    guard.controls = controls
