"""The page's server, for this machine alone; imports little, so that a browser loads the page while
a scene is read.
"""

import contextlib
import http
import io
import secrets
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from rbfmuscle.validation import MissingPartError, UsageError

if TYPE_CHECKING:
    from viser import ViserServer
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

LOOPBACK = "127.0.0.1"
INSTALL = 'python -m pip install "viser>=1.1,<2"'  # as the extra `web` in pyproject.toml has it


class Gate:
    """Refuses requests whose path does not begin with the token, and websockets of pages of another
    origin.

    The ``Host`` is checked as well, because a foreign name can be made to point to the loopback
    address.
    """

    def __init__(self, token: str) -> None:
        self.token = token
        self.inner: Callable[..., Response | None] | None = (
            None  # what answers requests that are let in
        )

    def __call__(self, connection: "ServerConnection", request: "Request") -> "Response | None":
        """Answer a request; None lets a websocket begin."""
        hosts = [f"{name}:{connection.local_address[1]}" for name in (LOOPBACK, "localhost")]
        host, origin = (request.headers.get(key, "") for key in ("Host", "Origin"))
        _, token, *rest = request.path.partition("?")[0].split("/")
        known = secrets.compare_digest(token.encode(), self.token.encode())
        foreign = host not in hosts or ("Upgrade" in request.headers and origin != f"http://{host}")
        if not known or foreign or self.inner is None:
            return connection.respond(
                http.HTTPStatus.FORBIDDEN, "Open the address that rbfmuscle printed.\n"
            )
        request.path = "/" + "/".join(rest)
        return self.inner(connection, request)


@contextlib.contextmanager
def _every_request_through(gate: Gate) -> Iterator[None]:
    """Put the gate before any websocket server that starts meanwhile; viser has no setting
    for it.
    """
    from websockets.asyncio import server as module

    plain = module.serve

    def serve(*arguments: Any, process_request: Any = None, **options: Any) -> Any:
        gate.inner = process_request
        return plain(*arguments, process_request=gate, **options)

    module.serve = serve
    try:
        yield
    finally:
        module.serve = plain


def open_server(port: int = 0) -> "tuple[ViserServer, str]":
    """Start a server on the loopback address, at any free port for 0; return it and its address
    with the token.

    MissingPartError if viser is not installed, or does not let its requests be checked.
    """
    try:
        import viser
    except ImportError:
        raise MissingPartError(
            f"the viewer needs viser, which is not installed; run: {INSTALL}"
        ) from None
    if not 0 <= port <= 65535:
        raise UsageError(f"--port {port}: ports go from 0 to 65535")
    gate = Gate(secrets.token_urlsafe(16))
    with _every_request_through(gate), contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=LOOPBACK, port=port, label="rbfmuscle", verbose=False)
    if gate.inner is None:
        server.stop()
        raise MissingPartError(
            f"requests to viser {viser.__version__} cannot be checked; run: {INSTALL}"
        )
    # Software drawing takes long for shadows, and longer for light from an image.
    server.scene.configure_default_lights(cast_shadow=False)
    server.scene.configure_environment_map(None)
    server.scene.add_light_ambient("/ambient", intensity=1.5)
    return server, f"http://{LOOPBACK}:{server.get_port()}/{gate.token}/"
