"""What tests with several processes of torch.distributed need."""

from __future__ import annotations

import contextlib
import socket


def free_port() -> int:
    """A TCP port that nobody listens on."""
    with contextlib.closing(socket.socket()) as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]
