"""An MJPEG stream over HTTP, as network cameras and phones give it."""

import http.server
import threading
from collections.abc import Callable


class MjpegStream:
    """Serves at `url` until it is closed; each connection gets frames by itself."""

    def __init__(self, next_frame: Callable[[], bytes | None], port: int = 0) -> None:
        """Begin to serve.

        Args:
            next_frame: waits for the next frame, as JPEG; None ends the connection that asks.
            port: of the server; 0 takes a free one.
        """

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.send_response(200)
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
                self.end_headers()
                while (jpeg := next_frame()) is not None:
                    head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
                    try:
                        self.wfile.write(head.encode() + jpeg + b"\r\n")
                    except OSError:
                        return

            def log_message(self, *_: object) -> None:
                pass

        self._server = http.server.ThreadingHTTPServer(("127.0.0.1", port), Handler)
        self._server.daemon_threads = True
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}/stream.mjpg"
        threading.Thread(target=self._server.serve_forever, args=(0.02,), daemon=True).start()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
