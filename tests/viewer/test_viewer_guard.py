"""Access control of a page against viser's real server, by raw sockets: who may connect, largest message."""

import itertools
import socket
from collections.abc import Iterator

import mi_refgs  # noqa: F401  (first: it chooses the libLLVM that Dr.Jit loads)

# isort: split
import pytest
import viser
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.viewer.guard import MESSAGE_BYTES
from mi_refgs.viewer.page import Page
from mi_refgs.viewer.reconstruction_view import ReconstructionView

WAIT = 20.0  # seconds that a busy machine may take to answer
UPGRADE = (
    "Upgrade: websocket",
    "Connection: Upgrade",
    "Sec-WebSocket-Version: 13",
    "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==",
)
OWN = ("Host: 127.0.0.1:{port}", "Host: localhost", "Host: LOCALHOST:9000", "Host: [::1]:{port}")
FOREIGN = ("Host: evil.example", "Host: 127.0.0.1.evil.example", "Host: localhost@evil.example", "Host: [")
ADDRESS = "Host: 192.0.2.7"
"""This machine only where the page listens at every address: nobody can redirect it."""
OWN_ORIGIN = "Origin: http://127.0.0.1:{port}"
FOREIGN_ORIGINS = ("Origin: http://evil.example", "Origin: null", "Origin: http://127.0.0.1:1", "Origin: ")


@pytest.fixture(scope="module", params=["127.0.0.1", "0.0.0.0"])
def page(
    request: pytest.FixtureRequest, scene: TrainedScene, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Page]:
    """A page for this machine only, and one for others, too; nothing is drawn."""
    made = Page(ReconstructionView(scene), {}, "a page", (request.param, 0), tmp_path_factory.mktemp("page"))
    yield made
    made.close()


def status(page: Page, *headers: str) -> int:
    """The status of the answer to a request with these headers."""
    port = page.server.get_port()
    lines = ["GET / HTTP/1.1", *(header.format(port=port) for header in headers), "", ""]
    with socket.create_connection(("127.0.0.1", port), timeout=WAIT) as raw:
        raw.sendall("\r\n".join(lines).encode())
        return int(raw.recv(64).split()[1])


@pytest.mark.parametrize("upgrade", [(), UPGRADE], ids=["page", "websocket"])
def test_a_request_needs_host_and_origin_of_the_page(page: Page, upgrade: tuple[str, ...]) -> None:
    answered, local = 101 if upgrade else 200, page.url.startswith("http://127.0.0.1:")
    for own in OWN:
        assert status(page, own, *upgrade) == answered, own
    assert status(page, OWN[0], OWN_ORIGIN, *upgrade) == answered
    assert status(page, ADDRESS, *upgrade) == (403 if local else answered)
    refused: list[tuple[str, ...]] = [(foreign,) for foreign in FOREIGN]
    refused += [(OWN[0], origin) for origin in FOREIGN_ORIGINS]
    refused += [(OWN[0], OWN_ORIGIN, FOREIGN_ORIGINS[0]), *itertools.permutations((OWN[0], FOREIGN[0])), ()]
    for headers in refused:
        assert status(page, *headers, *upgrade) == 403, headers


def test_a_message_beyond_the_largest_ends_its_connection(page: Page) -> None:
    protocols = [f"viser-v{viser.__version__}"]
    url = f"ws://127.0.0.1:{page.server.get_port()}"
    with connect(url, subprotocols=protocols, max_queue=None) as client:  # type: ignore[arg-type]
        with pytest.raises(ConnectionClosed) as closed:
            client.send(b"x" * (MESSAGE_BYTES + 1))
            while True:
                client.recv(timeout=WAIT)
    assert closed.value.rcvd is not None and closed.value.rcvd.code == 1009
