"""Access control of a page: viser itself answers every host and every site. A page listens at this machine
only unless the user names another address. A request needs the page's own host name, so that no foreign name
that resolves to this machine reaches it, and no other site's `Origin`; messages have a largest size."""

import contextlib
import ipaddress
import socket
from collections.abc import Iterator
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

from websockets.asyncio import server as websockets_server
from websockets.datastructures import Headers

LOOPBACK = ("localhost", "127.0.0.1", "::1")  # names of this machine that only it can use
MESSAGE_BYTES = 2**20  # largest message: viser's script sends files in parts of half of it


def refusal(headers: Headers, own: str) -> str | None:
    """Return why the server at host `own` refuses a request, one sentence; None for one that it answers."""
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    if len(hosts) != 1 or not _is_own(hosts[0], own.lower()):
        return "This server answers to its own host name only: open the address that the terminal shows."
    allowed = [f"{scheme}://{hosts[0]}".lower() for scheme in ("http", "https")]
    if any(origin.lower() not in allowed for origin in origins):
        return "Pages of other sites may not use this server."
    return None


def _is_own(host: str, own: str) -> bool:
    """Whether a Host header names this server; the owner of a foreign name may resolve it to here."""
    with contextlib.suppress(ValueError):
        name = urlsplit(f"//{host}").hostname or ""
        if name in LOOPBACK or name == own:
            return True
        if own not in LOOPBACK:
            return name == socket.gethostname().lower() or bool(ipaddress.ip_address(name))
    return False


@contextlib.contextmanager
def guarded(host: str) -> Iterator[None]:
    """Let the WebSocket server that is created inside, at `host`, refuse requests and large messages."""
    original = websockets_server.serve

    def serve(*arguments: Any, process_request: Any, **options: Any) -> Any:
        def check(connection: Any, request: Any) -> Any:
            if (reason := refusal(request.headers, host)) is not None:
                return connection.respond(HTTPStatus.FORBIDDEN, f"{reason}\n")
            return process_request(connection, request)

        return original(*arguments, **options | {"max_size": MESSAGE_BYTES, "process_request": check})

    websockets_server.serve = serve  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        websockets_server.serve = original  # type: ignore[misc]
