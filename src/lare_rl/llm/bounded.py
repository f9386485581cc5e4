"""Limits on a server's answers: the time of a whole answer, headers included, and 8 MB, whatever its status."""

import importlib
import queue
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from typing import Any

LARGEST_BODY = 8 << 20
"""The largest size in bytes of an answer."""


class TooMuch(Exception):
    """An answer is too large."""


class Elsewhere(Exception):
    """A server redirects to another server."""


def stay(response: Any) -> None:
    """Raise `Elsewhere` if an answer redirects to another origin, which would receive the request with the task."""
    if not response.has_redirect_location:
        return
    here = response.request.url
    there = here.join(response.headers["location"])
    if (there.scheme, there.host, there.port) != (here.scheme, here.host, here.port):
        raise Elsewhere(
            f"it redirects to {there.scheme}://{there.netloc.decode()}, another server: name that one to use it"
        )


def bound(response: Any, limit: float) -> None:
    """Limit the time (in seconds) and the size of an answer's body, whatever its status."""
    # The HTTP library depends on the client's version, and a stream must be of that library's class.
    library = importlib.import_module(type(response).__module__.partition(".")[0])

    class Bounded(library.SyncByteStream):
        def __init__(self, stream: Any):
            self.stream = stream

        def __iter__(self) -> Iterator[bytes]:
            size, deadline = 0, time.monotonic() + limit
            for chunk in self.stream:
                piece = chunk if unpacked is None else unpacked.decompress(chunk, LARGEST_BODY + 1)
                size += len(piece)
                if size > LARGEST_BODY:
                    raise TooMuch(f"the answer has more than {LARGEST_BODY >> 20} MB")
                if time.monotonic() > deadline:
                    raise TimeoutError(f"the answer was not complete after {limit:.0f} s")
                yield piece

        def close(self) -> None:
            self.stream.close()

    # A few bytes can unpack to gigabytes, so they are unpacked here, up to the largest size.
    packing = response.headers.pop("content-encoding", "identity").strip().lower()
    if packing not in ("identity", "", "gzip", "deflate"):
        raise OSError(f"the answer is packed as {packing}, which was not asked for")
    unpacked = zlib.decompressobj(47) if packing in ("gzip", "deflate") else None
    response.stream = Bounded(response.stream)


def in_time(fetch: Callable[[], bytes], limit: float) -> bytes:
    """What `fetch` returns or raises. Raises `TimeoutError` if it takes longer than `limit` seconds. A socket's own time-out is not
    enough: a server may send its headers byte by byte, and each byte starts that time-out again.
    """
    outcome: queue.SimpleQueue[tuple[bytes, BaseException | None]] = queue.SimpleQueue()

    def run() -> None:
        try:
            outcome.put((fetch(), None))
        except BaseException as error:
            outcome.put((b"", error))

    threading.Thread(target=run, daemon=True).start()
    try:
        body, error = outcome.get(timeout=1.1 * limit)  # the sockets' own time-outs come first, with better messages
    except queue.Empty:
        raise TimeoutError(f"the answer was not complete after {limit:.0f} s") from None
    if error is not None:
        raise error
    return body
