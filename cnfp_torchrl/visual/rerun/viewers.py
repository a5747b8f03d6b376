"""The viewers that can show a recording while it grows."""

from __future__ import annotations

import os
import socket
import sys
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar
from urllib.parse import quote, urlsplit

import rerun_cli

from cnfp_torchrl.visual.rerun.follow import Address, is_listening

LOOPBACK = "127.0.0.1"
WEB_PORT, PORT = 9090, 9876
"""The usual ports of the web viewer's page, and of recordings."""

_PATIENCE_S = 5.0
"""How long a viewer that listens may take to answer, on a machine that is busy with training."""
_HTTP2_PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes(3) + b"\x04" + bytes(5)
"""What opens every gRPC connection (RFC 9113, section 3.4), with empty settings."""
_HTTP2_SETTINGS = 4
_DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")


class SinkError(RuntimeError):
    """A recording cannot go where it was asked to go: says what was expected and what to do."""


class Viewer(ABC):
    """A viewer, or a server for viewers, that listens at an address for a recording.

    Args:
        host: The host that it listens at.
        port: The port that it listens at.
    """

    stays_open: ClassVar[bool] = False
    """Whether what was started for the recording is left open when that ends."""

    def __init__(self, host: str, port: int) -> None:
        self.host = host
        self.port = port

    @abstractmethod
    def require(self) -> None:
        """Refuse what cannot work, before anything is started.

        Raises:
            SinkError: saying what was expected, what there is, and what to do.
        """

    @abstractmethod
    def command(self) -> list[str]:
        """Return the command that starts it, empty where it runs already."""

    def relay(self, source: str = "-") -> list[str]:
        """Return the command that hands on to it a file, or what is read from the standard input.

        Given the address of a viewer that listens, Rerun hands on to it what it reads.
        """
        found = socket.getaddrinfo(self.host, self.port, type=socket.SOCK_STREAM)
        return [executable(), source, "--bind", str(found[0][4][0]), "--port", str(self.port)]

    @abstractmethod
    def __str__(self) -> str:
        """Return its name, as a message begins."""

    @property
    def addresses(self) -> list[Address]:
        """Where somebody listens when everything is there that was asked for."""
        return [(self.host, self.port)]

    def is_listening(self) -> bool:
        """Tell whether everything is there that was asked for."""
        return all(map(is_listening, self.addresses))


class RunningViewer(Viewer):
    """A viewer that runs already, here or behind a tunnel: start one with ``rerun``.

    Args:
        url: The address that it listens at, ``rerun+http://HOST:PORT/proxy``.

    Raises:
        SinkError: when that is no address of a viewer.
    """

    def __init__(self, url: str = "rerun+http://127.0.0.1:9876/proxy") -> None:
        parts = urlsplit(url)
        try:
            host, port = parts.hostname, parts.port
        except ValueError:
            host = port = None
        if parts.scheme != "rerun+http" or parts.path != "/proxy" or not host or not port:
            raise SinkError(
                f"url: expected a viewer's address, rerun+http://HOST:PORT/proxy, given {url!r}"
            )
        super().__init__(host, port)
        self._url = url

    def require(self) -> None:
        try:
            answer = self._greet()
        except OSError as error:
            raise SinkError(
                f"visual=connect: expected a Rerun viewer that listens at {self._url}, found none "
                f"({error}); start one with: rerun --port {self.port}"
            ) from None
        if len(answer) < 4 or answer[3] != _HTTP2_SETTINGS:
            raise SinkError(
                f"visual=connect: expected a Rerun viewer that listens at {self._url}, but "
                f"something else does; start one on another port with: rerun --port auto"
            )

    def command(self) -> list[str]:
        return []

    def _greet(self) -> bytes:
        with socket.create_connection((self.host, self.port), _PATIENCE_S) as connection:
            connection.settimeout(_PATIENCE_S)
            connection.sendall(_HTTP2_PREFACE)
            return connection.recv(64)

    def __str__(self) -> str:
        return f"visual=connect: the viewer at {self._url}"


class WebViewer(Viewer):
    """Rerun's web viewer for a browser, served while the recording is open.

    Args:
        web_port: The port of the page.
        port: The port of the data that the page fetches.
        host: The address to listen at; everybody who reaches it can look.
        memory_limit: The memory limit of the data kept for those who come later, such as
            ``256MiB``; the oldest are dropped. The file keeps everything.
    """

    def __init__(
        self,
        web_port: int = WEB_PORT,
        port: int = PORT,
        host: str = LOOPBACK,
        memory_limit: str = "256MiB",
    ) -> None:
        super().__init__(host, port)
        self.web_port = web_port
        self._memory_limit = memory_limit

    @property
    def url(self) -> str:
        """The page to open in a browser."""
        source = quote(f"rerun+http://{self.host}:{self.port}/proxy", safe="")
        # Dark, as views and curves are meant to be seen; else the browser's own theme is taken.
        return f"http://{self.host}:{self.web_port}/?url={source}&theme=dark"

    def require(self) -> None:
        if self.web_port == self.port:
            raise SinkError(
                f"visual=serve: expected two ports, given web_port and port {self.port}"
            )
        _require_free("visual=serve: visual.viewer.web_port", self.host, self.web_port)
        _require_free("visual=serve: visual.viewer.port", self.host, self.port)

    def command(self) -> list[str]:
        ports = ["--port", str(self.port), "--web-viewer-port", str(self.web_port)]
        limit = ["--server-memory-limit", self._memory_limit]
        return [executable(), "--serve-web", "--bind", self.host, *ports, *limit]

    @property
    def addresses(self) -> list[Address]:
        return [*super().addresses, (self.host, self.web_port)]

    def __str__(self) -> str:
        return f"visual=serve: the web viewer at {self.url}"


class ViewerWindow(Viewer):
    """A window of its own, which stays open when the recording ends.

    Args:
        memory_limit: The memory limit of the window, such as ``1GiB``; the oldest data are dropped.
        port: The port that it listens at, on loopback; None takes a free one.
        arguments: Further arguments for ``rerun``, such as ``--renderer=gl``.
    """

    stays_open = True

    def __init__(
        self,
        memory_limit: str = "1GiB",
        port: int | None = None,
        arguments: Sequence[str] = (),
    ) -> None:
        super().__init__(LOOPBACK, free_port() if port is None else port)
        self._memory_limit, self._arguments = memory_limit, list(arguments)

    def require(self) -> None:
        if "--headless" not in self._arguments and not has_display():
            raise SinkError(
                f"visual=spawn: expected a display, but none of {', '.join(_DISPLAYS)} is set; "
                "take visual=serve and open its page in a browser, or visual=file and look later"
            )
        _require_free("visual=spawn: visual.viewer.port", self.host, self.port)

    def command(self) -> list[str]:
        address = ["--hide-welcome-screen", "--bind", self.host, "--port", str(self.port)]
        limits = ["--memory-limit", self._memory_limit, "--server-memory-limit", "64MiB"]
        return [executable(), *address, *limits, *self._arguments]

    def __str__(self) -> str:
        return "visual=spawn: the viewer's window"


def has_display() -> bool:
    """Tell whether there is a display to open windows on."""
    return sys.platform != "linux" or any(os.environ.get(name) for name in _DISPLAYS)


def executable() -> str:
    """Return the path of Rerun's command line."""
    return str(Path(rerun_cli.__file__).with_name("rerun"))


def _require_free(name: str, host: str, port: int) -> None:
    try:
        with socket.socket() as probe:
            # As servers do: the connections of one that ended a moment ago do not count.
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
    except (OSError, OverflowError) as error:
        raise SinkError(
            f"{name}: expected a free port of {host}, given {port} ({error}); choose another"
        ) from None


def free_port(preferred: int = 0) -> int:
    """Return a port of loopback that is free: the preferred one, or any."""
    try:
        _require_free("port", LOOPBACK, preferred)
    except SinkError:
        preferred = 0
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind((LOOPBACK, preferred))
        return int(probe.getsockname()[1])
