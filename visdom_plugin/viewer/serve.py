"""The viewer's address: a free port, and how to reach it from elsewhere."""

from __future__ import annotations

import socket
from importlib.util import find_spec

from visdom_plugin.errors import ConfigError, PluginError

FIRST = 8080
_TRIED = 100


def choose_port(host: str, port: int | None) -> int:
    """The port asked for, or the first free one from `FIRST`.

    Raises:
        ConfigError: it is in use, or the host is none of this machine's.
    """
    for candidate in range(FIRST, FIRST + _TRIED) if port is None else (port,):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host, candidate))
                return candidate
            except (OSError, OverflowError) as error:
                why = getattr(error, "strerror", None) or str(error)
    raise ConfigError(
        f"port {candidate} of {host} cannot be had: {why}",
        where=f"--port {port}" if port is not None else f"--host {host}",
        todo="leave --port out, and a free one is taken" if port is not None else "choose another --host",
    )


def require_viser() -> None:
    """Refuses where viser is not installed, before anything is loaded.

    Raises:
        PluginError: it is not.
    """
    if find_spec("viser") is None:
        raise PluginError(
            "the viewer needs viser, which is not installed",
            todo="pip install 'visdom-plugin[viewer]'",
            topic="not-installed",
        )


def describe_address(host: str, port: int) -> list[str]:
    """The address, and a line on how to reach it through ssh."""
    shown = "localhost" if host in ("127.0.0.1", "localhost", "0.0.0.0") else host
    return [
        f"http://{shown}:{port}",
        f"from another machine: ssh -L {port}:localhost:{port} {socket.gethostname()}, then that address there",
    ]
