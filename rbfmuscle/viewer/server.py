"""The page's server, for this machine alone; imports little, so that a browser loads the page while
a scene is read.
"""

import contextlib
import http
import io
import secrets
from collections.abc import Callable
from types import FunctionType, SimpleNamespace
from typing import TYPE_CHECKING

from rbfmuscle.validation import MissingDependencyError, UsageError

if TYPE_CHECKING:
    from viser import ViserServer
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

LOOPBACK = "127.0.0.1"


class Gate:
    """Refuses requests whose path does not begin with the token, and websockets of pages of another
    origin.

    The ``Host`` is checked as well, because a foreign name can be made to point to the loopback
    address.
    """

    def __init__(self, token: str) -> None:
        self.token = token
        # What answers requests that are let in.
        self.inner: Callable[..., Response | None] | None = None

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


def _with_globals(function: FunctionType, **names: object) -> FunctionType:
    """A copy of a function that sees other values of some global names of its module."""
    seen = {**function.__globals__, **names}
    copy = FunctionType(
        function.__code__, seen, function.__name__, function.__defaults__, function.__closure__
    )
    copy.__kwdefaults__ = function.__kwdefaults__
    return copy


def _gated_server(gate: Gate) -> "type[ViserServer]":
    """A class of viser's server whose requests go through a gate.

    Viser has no setting for it. Copies of the two functions that start its websocket server see
    another ``serve``; no module is changed, and no other server of the process is concerned.
    """
    import viser
    import websockets.asyncio.server
    from viser import infra

    def serve(
        *arguments: object,
        process_request: "Callable[..., Response | None] | None" = None,
        **options: object,
    ) -> object:
        gate.inner = process_request
        return websockets.asyncio.server.serve(*arguments, process_request=gate, **options)

    server = SimpleNamespace(**{**vars(websockets.asyncio.server), "serve": serve})
    seen = SimpleNamespace(**{**vars(websockets), "asyncio": SimpleNamespace(server=server)})

    class GatedWebsockServer(infra.WebsockServer):
        _background_worker = _with_globals(infra.WebsockServer._background_worker, websockets=seen)

    inside = SimpleNamespace(**{**vars(infra), "WebsockServer": GatedWebsockServer})

    class GatedServer(viser.ViserServer):
        __init__ = _with_globals(viser.ViserServer.__init__, infra=inside)

    return GatedServer


def open_server(port: int = 0) -> "tuple[ViserServer, str]":
    """Start a server on the loopback address, at any free port for 0; return it and its address
    with the token.

    MissingDependencyError if viser does not let its requests be checked.
    """
    import viser

    if not 0 <= port <= 65535:
        raise UsageError(f"--port {port}: ports go from 0 to 65535")
    gate = Gate(secrets.token_urlsafe(16))
    with contextlib.redirect_stdout(io.StringIO()):
        server = _gated_server(gate)(host=LOOPBACK, port=port, label="rbfmuscle", verbose=False)
    if gate.inner is None:
        server.stop()
        raise MissingDependencyError(
            f"requests to viser {viser.__version__} cannot be checked; install another version"
        )
    # Software drawing takes long for shadows, and longer for light from an image.
    server.scene.configure_default_lights(cast_shadow=False)
    server.scene.configure_environment_map(None)
    server.scene.add_light_ambient("/ambient", intensity=1.5)
    return server, f"http://{LOOPBACK}:{server.get_port()}/{gate.token}/"
