"""A real HTTP server on a real socket that answers from a script: the client's conversation, turn by turn."""

import json
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


class Turn:
    """One request as it came in."""

    def __init__(self, method: str, path: str, headers: dict[str, str], body: object) -> None:
        self.method, self.path, self.headers, self.body = method, path, headers, body


class Script:
    """Answers by a function of the request; `None` drops the connection, bytes go out as they are. Keeps every turn.

    `headers` go with every answer; they may be changed while it is made.
    """

    def __init__(self, answer: Callable[[Turn], tuple[int, object] | None]) -> None:
        self.answer = answer
        self.turns: list[Turn] = []
        self.url = ""


@contextmanager
def serve(
    answer: Callable[[Turn], tuple[int, object] | None], headers: Mapping[str, str] | None = None
) -> Iterator[Script]:
    script = Script(answer)

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def _turn(self) -> None:
            length = int(self.headers.get("content-length", 0))
            raw = self.rfile.read(length)
            turn = Turn(
                self.command,
                self.path,
                {k.lower(): v for k, v in self.headers.items()},
                json.loads(raw) if raw else None,
            )
            script.turns.append(turn)
            said = script.answer(turn)
            if said is None:
                self.close_connection = True
                return
            status, document = said
            body = document if isinstance(document, bytes) else json.dumps(document).encode()
            kind = "application/problem+json" if status >= 400 else "application/json"
            self.send_response(status)
            for name, value in {"content-type": kind, "content-length": str(len(body)), **(headers or {})}.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(body)

        do_GET = do_POST = _turn

        def log_message(self, *_: object) -> None:
            """Stay quiet."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    script.url = f"http://127.0.0.1:{server.server_address[1]}"
    try:
        yield script
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
