"""A local HTTP receiver of alerts: it notes what is posted and called, and hangs when it is asked to."""

import json
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


class Receiver:
    """messages: what was posted, as (title, text). calls: paths that were got."""

    def __init__(self):
        self.messages: list[tuple[str, str]] = []
        self.calls: list[str] = []
        self.status = 200
        self.let_go = threading.Event()
        self.let_go.set()
        receiver = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self):
                body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
                receiver.let_go.wait(60)
                if receiver.status == 200:
                    receiver.messages.append((body["title"], body["message"]))
                self._answer()

            def do_GET(self):
                receiver.calls.append(self.path)
                receiver.let_go.wait(60)
                self._answer()

            def _answer(self):
                self.send_response(receiver.status)
                self.send_header("Content-Length", "0")
                self.end_headers()

            def log_message(self, *args):
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.server.daemon_threads = True
        self.port = self.server.server_port
        threading.Thread(target=self.server.serve_forever, args=(0.05,), daemon=True).start()

    def secrets(self, path, *more):
        """A file of secrets for it."""
        urls = [f"json://127.0.0.1:{self.port}/TOKEN", *more]
        path.write_text(f"urls: {json.dumps(urls)}\nalive_url: http://127.0.0.1:{self.port}/alive/TOKEN\n")
        path.chmod(0o600)
        return path

    def close(self):
        self.let_go.set()
        self.server.shutdown()
        self.server.server_close()


def until(condition, limit_s=60.0):
    """Wait for a thread or a process."""
    end_s = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < end_s, "it has not come"
        threading.Event().wait(0.01)
