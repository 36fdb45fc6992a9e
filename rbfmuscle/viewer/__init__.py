"""The viewer in the browser: its server, for this machine alone.

What is here imports little, so that a browser loads the page while a scene is read.
"""

import contextlib
import io
from typing import TYPE_CHECKING

from rbfmuscle.validation import UsageError

if TYPE_CHECKING:
    from viser import ViserServer

LOOPBACK = "127.0.0.1"


def open_server(port: int = 0) -> "tuple[ViserServer, str]":
    """Start a server on the loopback address, at any free port for 0; return it and its address."""
    import viser

    if not 0 <= port <= 65535:
        raise UsageError(f"port {port}: ports go from 0 to 65535")
    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=LOOPBACK, port=port, label="rbfmuscle", verbose=False)
    # Software drawing takes long for shadows, and longer for light from an image.
    server.scene.configure_default_lights(cast_shadow=False)
    server.scene.configure_environment_map(None)
    server.scene.add_light_ambient("/ambient", intensity=1.5)
    return server, f"http://{LOOPBACK}:{server.get_port()}/"
