"""A language model's server on loopback, and answers that it can give."""

import gzip
import json
import socket
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

Answer = Callable[["Handler"], None]


def text_completion(text: str | None, usage: dict | None = None, **message: Any) -> dict[str, Any]:
    message = {"role": "assistant", "content": text, **message}
    return {
        "id": "1",
        "object": "chat.completion",
        "created": 0,
        "model": "m",
        "choices": [{"index": 0, "finish_reason": "stop", "message": message}],
        "usage": {"prompt_tokens": 100, "completion_tokens": 10, "total_tokens": 110} if usage is None else usage,
    }


def text_response(text: str | None, usage: dict | None = None, refusal: str | None = None) -> dict[str, Any]:
    """Return an answer of OpenAI's Responses API, from a model that reasons."""
    contents = [{"type": "output_text", "text": text, "annotations": []}] if text else []
    contents += [{"type": "refusal", "refusal": refusal}] if refusal else []
    return {
        "id": "1",
        "object": "response",
        "created_at": 0,
        "status": "completed",
        "error": None,
        "incomplete_details": None,
        "model": "m",
        "output": [
            {"type": "reasoning", "id": "2", "summary": []},
            {"type": "message", "id": "3", "role": "assistant", "status": "completed", "content": contents},
        ],
        "usage": {"input_tokens": 100, "output_tokens": 10, "total_tokens": 110} if usage is None else usage,
    }


def request_messages(request: dict[str, Any]) -> list[dict[str, str]]:
    """Return the messages of a request, of either API."""
    return request["messages"] if "messages" in request else request["input"]


class Handler(BaseHTTPRequestHandler):
    server: "Server"

    def do_POST(self) -> None:
        self.server.requests.append(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
        self.server.headers.append(self.headers)
        self.server.apis.append(self.api)
        answers = self.server.answers
        answer = answers.pop(0) if len(answers) > 1 else answers[0]
        answer(self)

    @property
    def api(self) -> str:
        return self.path.rpartition("/")[2]

    def send_text(self, text: str | None, **details: Any) -> None:
        """Answer a request of either API."""
        answer = text_response if self.api == "responses" else text_completion
        self.send(200, json.dumps(answer(text, **details)).encode())

    def send(self, status: int, body: bytes, **headers: str) -> None:
        self.begin(status, Content_Length=str(len(body)), **headers)
        self.wfile.write(body)

    def begin(self, status: int, **headers: str) -> None:
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        for name, value in headers.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()

    def send_forever(self, chunk: bytes, pause_s: float) -> None:
        try:
            while True:
                self.wfile.write(chunk)
                self.wfile.flush()
                threading.Event().wait(pause_s)
        except OSError:
            return

    def log_message(self, *args: Any) -> None: ...


class Server(ThreadingHTTPServer):
    """Gives its answers one after the other, and the last one from then on. It records the requests and their headers."""

    daemon_threads = True

    def __init__(self, *answers: Answer):
        super().__init__(("127.0.0.1", 0), Handler)
        self.answers = list(answers)
        self.requests: list[dict] = []
        self.headers: list[Any] = []
        self.apis: list[str] = []
        self.url = f"http://127.0.0.1:{self.server_port}/v1"
        threading.Thread(target=self.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()

    def stop(self) -> None:
        self.shutdown()
        self.server_close()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore a client that hangs up."""


def reply_with(text: str | None, **details: Any) -> Answer:
    return lambda handler: handler.send_text(text, **details)


def raw_answer(body: bytes, status: int = 200, **headers: str) -> Answer:
    return lambda handler: handler.send(status, body, **headers)


def refuse(status: int, message: str = "no", **headers: str) -> Answer:
    return raw_answer(json.dumps({"error": {"message": message}}).encode(), status, **headers)


def hang_up(handler: Handler) -> None:
    handler.connection.shutdown(socket.SHUT_RDWR)


def reset_connection(handler: Handler) -> None:
    # Closing a socket that does not linger sends a reset.
    handler.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\x01\0\0\0\0\0\0\0")
    handler.connection.close()


def break_off(handler: Handler) -> None:
    """Send half of a body."""
    handler.begin(200, Content_Length="1000")
    handler.wfile.write(b'{"choices": [')
    handler.connection.shutdown(socket.SHUT_RDWR)


def endless_body(status: int, chunk: bytes, pause_s: float = 0.0) -> Answer:
    """Send one chunk of the body after the other, without end."""

    def answer(handler: Handler) -> None:
        handler.begin(status)
        handler.send_forever(chunk, pause_s)

    return answer


def drip_headers(handler: Handler) -> None:
    """Send a letter of a header now and then, without end."""
    handler.wfile.write(b"HTTP/1.1 200 OK\r\nX-Slow: ")
    handler.send_forever(b"a", 0.05)


def send_bomb(handler: Handler) -> None:
    """Send 16 MB in a few bytes."""
    handler.send(200, gzip.compress(gzip.compress(b" " * (16 << 20))), Content_Encoding="gzip, gzip")
