"""Answers that end: 120 s for all of one, headers too, and 8 MB, whatever its status."""

import importlib
import queue
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from typing import Any

TIMEOUT = 120.0
"""Seconds for one reply."""

LARGEST_BODY = 8 << 20
"""Bytes of an answer."""


class TooMuch(Exception):
    """An answer has no end."""


class Elsewhere(Exception):
    """A server sends whoever asks to another one."""


def stay(response: Any) -> None:
    """Raise `Elsewhere` where an answer leads to another origin: the request would be told to it, task and all."""
    if not response.has_redirect_location:
        return
    here = response.request.url
    there = here.join(response.headers["location"])
    if (there.scheme, there.host, there.port) != (here.scheme, here.host, here.port):
        raise Elsewhere(
            f"it redirects to {there.scheme}://{there.netloc.decode()}, another server: name that one if you mean it"
        )


def bound(response: Any) -> None:
    """Let the body of an answer, of whatever status, be read in time and no further than it may go."""
    # Which HTTP library is beneath depends on the client's version; a stream must be one of its own kind.
    library = importlib.import_module(type(response).__module__.partition(".")[0])

    class Bounded(library.SyncByteStream):
        def __init__(self, stream: Any):
            self.stream = stream

        def __iter__(self) -> Iterator[bytes]:
            size, deadline = 0, time.monotonic() + TIMEOUT
            for chunk in self.stream:
                piece = chunk if unpacked is None else unpacked.decompress(chunk, LARGEST_BODY + 1)
                size += len(piece)
                if size > LARGEST_BODY:
                    raise TooMuch(f"the answer has more than {LARGEST_BODY >> 20} MB")
                if time.monotonic() > deadline:
                    raise TimeoutError(f"the answer was not complete after {TIMEOUT:.0f} s")
                yield piece

        def close(self) -> None:
            self.stream.close()

    # A few bytes can unpack to gigabytes, so that is done here, no further than the answer may go.
    packing = response.headers.pop("content-encoding", "identity").strip().lower()
    if packing not in ("identity", "", "gzip", "deflate"):
        raise OSError(f"the answer is packed as {packing}, which nobody asked for")
    unpacked = zlib.decompressobj(47) if packing in ("gzip", "deflate") else None
    response.stream = Bounded(response.stream)


def in_time(fetch: Callable[[], bytes], limit: float) -> bytes:
    """What `fetch` returns or raises. Raises `TimeoutError` where it does neither in so many seconds: a server may say its headers
    letter by letter, and each one starts a socket's clock anew.
    """
    outcome: queue.SimpleQueue[tuple[bytes, BaseException | None]] = queue.SimpleQueue()

    def run() -> None:
        try:
            outcome.put((fetch(), None))
        except BaseException as error:
            outcome.put((b"", error))

    threading.Thread(target=run, daemon=True).start()
    try:
        body, error = outcome.get(timeout=1.1 * limit)  # the sockets' own clocks come first, and say more
    except queue.Empty:
        raise TimeoutError(f"the answer was not complete after {limit:.0f} s") from None
    if error is not None:
        raise error
    return body
