"""A reader of a page of ``warp_spo.viewing`` in a process of its own: it takes what a browser would, and draws nothing.

    python -m benchmarks.page_client http://localhost:8080

It needs no Chromium. It reports a camera, without which the server counts nobody, and ends when the server does.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

PATIENCE = 60.0  # until the reader is there [s]
CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (1.0, 1.0, 1.0), "fov": 0.75, "near": 0.01,
    "far": 1e3, "image_height": 900, "image_width": 900, "look_at": (0.0, 0.0, 0.0), "up_direction": (0.0, 0.0, 1.0),
}  # fmt: skip


def read(url: str, least: float = float("inf")) -> int:
    """Read what the page at an address sends until its server ends, or ``least`` messages; return their number."""
    import msgspec
    import viser
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect

    protocol: Any = f"viser-v{viser.__version__}"
    count = 0
    with connect(url.replace("http", "ws", 1), subprotocols=[protocol], max_size=None) as connection:
        connection.send(msgspec.msgpack.encode(CAMERA))
        with contextlib.suppress(ConnectionClosed):
            for _ in connection:
                count += 1
                if count >= least:
                    break
    return count


@contextlib.contextmanager
def looking(page: Any) -> Iterator[None]:
    """Let a reader look at a ``Page`` inside; a context manager.

    Raises:
        TimeoutError: the reader has not come.
    """
    command, root = [sys.executable, "-m", "benchmarks.page_client", page.url], Path(__file__).parent.parent
    reader, ends = subprocess.Popen(command, cwd=root), time.monotonic() + PATIENCE
    try:
        while not page.server.get_clients():
            if time.monotonic() > ends or reader.poll() is not None:
                raise TimeoutError(f"nobody looks at {page.url} after {PATIENCE:.0f} s")
            time.sleep(0.05)
        yield
    finally:
        reader.terminate()
        reader.wait()


if __name__ == "__main__":
    print(read(sys.argv[1]), "messages")
