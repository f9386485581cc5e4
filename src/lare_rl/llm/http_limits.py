"""Limits on an HTTP server: a time for its whole answer, 8 MB, and no redirect to another server.

The HTTP library depends on the version of OpenAI's client (httpx, or its successor). This module uses only what both share.
"""

import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future, wait
from typing import Any

__all__ = [
    "MAX_BODY_BYTES", "BodyTooLargeError", "RedirectError", "StatusError", "check_response", "read_body",
    "run_in_time",
]  # fmt: skip

MAX_BODY_BYTES = 8 << 20


class BodyTooLargeError(Exception):
    """An answer has more than `MAX_BODY_BYTES`."""


class RedirectError(Exception):
    """A server redirects to another server, which would receive the request."""


class StatusError(Exception):
    """An answer has an HTTP status of 400 or more."""

    def __init__(self, status: int, headers: Mapping[str, str], body: str):
        super().__init__(f"HTTP {status}")
        self.status, self.headers, self.body = status, headers, body


def check_response(response: Any) -> None:
    """Check a response before its body is read. This is an event hook of the HTTP client.

    Raises:
        RedirectError: it redirects to another scheme, host or port.
        StatusError: its status is an error. OpenAI's client would read the body of such a response without a limit.
    """
    if response.has_redirect_location:
        old = response.request.url
        new = old.join(response.headers["location"])
        if (new.scheme, new.host, new.port) != (old.scheme, old.host, old.port):
            raise RedirectError(
                f"it redirects to {new.scheme}://{new.netloc.decode()}, another server: name that one to use it"
            )
    elif response.is_error:
        raise StatusError(response.status_code, response.headers, read_body(response).decode(errors="replace"))


def read_body(response: Any) -> bytes:
    """Read the body of a response.

    Raises:
        BodyTooLargeError: the body is too large.
        OSError: the body is compressed in a way that the request does not allow.
    """
    # Chunks are unpacked one by one. A single compression can make a chunk of 64 KiB at most a thousand times as large; a second
    # one would square this.
    encoding = response.headers.get("content-encoding", "identity").strip().lower()
    if encoding not in ("identity", "", "gzip", "deflate"):
        raise OSError(f"the answer is compressed as {encoding}, which was not requested")
    body = bytearray()
    for chunk in response.iter_bytes():
        body += chunk
        if len(body) > MAX_BODY_BYTES:
            raise BodyTooLargeError(f"the answer has more than {MAX_BODY_BYTES >> 20} MB")
    return bytes(body)


def run_in_time(fetch: Callable[[], bytes], timeout_s: float) -> bytes:
    """Return what `fetch` returns, or raise what it raises.

    The time-out of a socket is not enough: a server may send its headers byte by byte, and each byte starts that time-out
    again.

    Raises:
        TimeoutError: `fetch` takes longer than `timeout_s`. Its thread then runs on.
    """
    answer: Future[bytes] = Future()

    def run() -> None:
        try:
            answer.set_result(fetch())
        except BaseException as error:
            answer.set_exception(error)

    threading.Thread(target=run, daemon=True).start()  # an executor would wait for it at the end of the program
    wait([answer], timeout=1.1 * timeout_s)  # time-outs of the sockets come first, with better messages
    if not answer.done():
        raise TimeoutError(f"the answer was not complete after {timeout_s:.0f} s")
    return answer.result()
