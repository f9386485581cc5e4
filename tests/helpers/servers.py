"""A language model's server on loopback, that behaves as it is told (`from helpers.servers import ...`)."""

import gzip
import json
import socket
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

Answer = Callable[["Handler"], None]


def completion(text: str | None, usage: dict | None = None, **message: Any) -> dict[str, Any]:
    return {
        "id": "1",
        "object": "chat.completion",
        "created": 0,
        "model": "m",
        "choices": [
            {"index": 0, "finish_reason": "stop", "message": {"role": "assistant", "content": text, **message}}
        ],
        "usage": {"prompt_tokens": 100, "completion_tokens": 10, "total_tokens": 110} if usage is None else usage,
    }


class Handler(BaseHTTPRequestHandler):
    server: "Server"

    def do_POST(self) -> None:
        body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        self.server.requests.append(body)
        self.server.headers.append(self.headers)
        answers = self.server.answers
        answer = answers.pop(0) if len(answers) > 1 else answers[0]
        answer(self)

    def send(self, status: int, body: bytes, **headers: str) -> None:
        self.send_response(status)
        for name, value in {"Content-Type": "application/json", "Content-Length": str(len(body)), **headers}.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *args: Any) -> None: ...


class Server(ThreadingHTTPServer):
    """Gives its answers one after the other, the last one for ever, and remembers what it was asked."""

    daemon_threads = True

    def __init__(self, *answers: Answer):
        super().__init__(("127.0.0.1", 0), Handler)
        self.answers = list(answers)
        self.requests: list[dict] = []
        self.headers: list[Any] = []
        self.url = f"http://127.0.0.1:{self.server_port}/v1"
        threading.Thread(target=self.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that hangs up is nothing to speak of."""


def says(text: str | None, **kwargs: Any) -> Answer:
    return lambda handler: handler.send(200, json.dumps(completion(text, **kwargs)).encode())


def raw(body: bytes, status: int = 200, **headers: str) -> Answer:
    return lambda handler: handler.send(status, body, **headers)


def refuses(status: int, message: str = "no", **headers: str) -> Answer:
    return raw(json.dumps({"error": {"message": message}}).encode(), status, **headers)


def hangs_up(handler: Handler) -> None:
    handler.connection.shutdown(socket.SHUT_RDWR)


def resets(handler: Handler) -> None:
    # Closing with something unread and no lingering sends a reset.
    handler.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\x01\0\0\0\0\0\0\0")
    handler.connection.close()


def half(handler: Handler) -> None:
    handler.send_response(200)
    handler.send_header("Content-Type", "application/json")
    handler.send_header("Content-Length", "1000")
    handler.end_headers()
    handler.wfile.write(b'{"choices": [')
    handler.connection.shutdown(socket.SHUT_RDWR)


def dribbles(handler: Handler, status: int = 200) -> None:
    """A byte now and then, and no end."""
    handler.send_response(status)
    handler.send_header("Content-Type", "application/json")
    handler.end_headers()
    try:
        while True:
            handler.wfile.write(b" ")
            handler.wfile.flush()
            threading.Event().wait(0.05)
    except OSError:
        return


def spells_headers(handler: Handler) -> None:
    """A letter of a header now and then, and no end."""
    try:
        handler.wfile.write(b"HTTP/1.1 200 OK\r\nX-Patience: ")
        while True:
            handler.wfile.write(b"a")
            handler.wfile.flush()
            threading.Event().wait(0.05)
    except OSError:
        return


def floods(handler: Handler, status: int = 200) -> None:
    """A megabyte after the other, and no end."""
    handler.send_response(status)
    handler.send_header("Content-Type", "application/json")
    handler.end_headers()
    try:
        while True:
            handler.wfile.write(b" " * (1 << 20))
    except OSError:
        return


def packed(encoding: str, times: int) -> Answer:
    """A little that is a lot when it is unpacked."""

    def answer(handler: Handler) -> None:
        body = b" " * (64 << 20)
        for _ in range(times):
            body = gzip.compress(body)
        handler.send(200, body, Content_Encoding=encoding)

    return answer


def refuses_without_end(handler: Handler) -> None:
    floods(handler, 500)


def refuses_slowly(handler: Handler) -> None:
    dribbles(handler, 500)
