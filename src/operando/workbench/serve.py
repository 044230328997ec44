"""The server of the workbench: on 127.0.0.1 alone, until Ctrl-C."""

from __future__ import annotations

import secrets
import signal
from types import FrameType
from typing import NoReturn

from operando.errors import ConfigError
from operando.workbench.bench import Bench


class Served:
    """A workbench whose address is taken; :meth:`forever` answers there.

    Parameters
    ----------
    port : int
        0 for a free one.

    Raises
    ------
    ConfigError
        If the port is taken.
    """

    def __init__(self, bench: Bench, port: int = 0) -> None:
        from werkzeug.serving import WSGIRequestHandler, make_server

        from operando.workbench.app import make_app

        class Quiet(WSGIRequestHandler):
            def log_request(self, code: int | str = "-", size: int | str = "-") -> None:
                """The terminal stays as it is."""

        self.bench, self.token = bench, secrets.token_urlsafe(24)
        app = make_app(bench, self.token)
        if port:
            _free(port)
        self._server = make_server("127.0.0.1", port, app, threaded=True, request_handler=Quiet)
        app.config["PORT"] = self._server.port
        self.address = f"http://127.0.0.1:{self._server.port}/?token={self.token}"

    def forever(self) -> None:
        """Answer until Ctrl-C or SIGTERM; then end the work under way and return."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, _interrupt)
        try:
            self._server.serve_forever()
        except KeyboardInterrupt:
            pass
        finally:
            self.close()

    def answer(self) -> None:
        """Answer until :meth:`close` is called in another thread."""
        self._server.serve_forever()

    def close(self) -> None:
        """End the work under way, and the server."""
        self.bench.stop()
        self._server.shutdown()
        self._server.server_close()


def _interrupt(number: int, frame: FrameType | None) -> NoReturn:
    raise KeyboardInterrupt


def _free(port: int) -> None:
    """Refuse a port that is taken: the server would end the process."""
    import socket

    with socket.socket() as trial:
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind(("127.0.0.1", port))
        except OSError as error:
            raise ConfigError(
                f"port {port} cannot be had: {error.strerror}", where="--port", hint="name another one, or none for a free one"
            ) from None
