"""Emulators of Waveshare's UGV, by serial line and HTTP."""

import contextlib
import http.server
import json
import threading
import time
import urllib.parse
from pathlib import Path

from tests.agent.drivers.emulators import LineEmulator, TwoWheels


class Ugv:
    """What the firmware of a Waveshare UGV does with a command: wiki "UGV Rover", JSON commands."""

    def __init__(self, wheels: TwoWheels, odometers: bool) -> None:
        self.wheels = wheels
        self.odometers = odometers
        self.watchdog = 3.0
        self.last = time.monotonic()
        self.stream = False
        self.interval = 0.1

    def obey(self, command: dict[str, float]) -> None:
        match command:
            case {"T": 1, "L": left, "R": right} if max(abs(left), abs(right)) <= 0.5:
                self.last = time.monotonic()
                self.wheels.set(left, right)
            case {"T": 136, "cmd": milliseconds}:
                self.watchdog = milliseconds / 1000
            case {"T": 131, "cmd": on}:
                self.stream = bool(on)
            case {"T": 142, "cmd": milliseconds}:
                self.interval = milliseconds / 1000

    def watch(self) -> None:
        """Without a new command within the heartbeat time the robot stops."""
        if time.monotonic() - self.last > self.watchdog and self.wheels.speeds != (0.0, 0.0):
            self.wheels.set(0.0, 0.0)

    def info(self) -> str:
        left, right = self.wheels.speeds
        answer = {"T": 1001, "L": left, "R": right, "r": 0.1, "p": -0.2, "v": 11.9}
        if self.odometers:
            ways = [round(100 * way) for way in self.wheels.way()]
            answer |= {"odl": ways[0], "odr": ways[1]}
        return json.dumps(answer)


class UgvSerial(LineEmulator):
    """A UGV on its UART."""

    def __init__(self, folder: Path, odometers: bool = False) -> None:
        self._odometers = odometers
        super().__init__(folder)

    def switched_on(self) -> None:
        super().switched_on()
        self.ugv = Ugv(self.wheels, self._odometers)
        self._reported = 0.0

    def line(self, line: str) -> None:
        with contextlib.suppress(ValueError):
            self.ugv.obey(json.loads(line))

    def idle(self) -> None:
        self.ugv.watch()
        if self.ugv.stream and not self.stalled and time.monotonic() - self._reported >= self.ugv.interval:
            self._reported = time.monotonic()
            self.say(self.ugv.info().encode() + b"\r\n")


class UgvHttp:
    """A UGV as a web server on 127.0.0.1; `path` is its address."""

    def __init__(self, folder: Path) -> None:
        self.wheels = TwoWheels()
        self.stalled = False
        self._port = 0
        self._closing = False
        self.plug_in()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    @property
    def path(self) -> str:
        return f"http://127.0.0.1:{self._port}"

    def plug_in(self) -> None:
        emulator = self
        self.ugv = Ugv(self.wheels, False)

        class Handler(http.server.BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_GET(self) -> None:
                while emulator.stalled and not emulator._closing:
                    time.sleep(0.01)
                path, _, query = self.path.partition("?")
                if path != "/js":
                    self.send_error(404)
                    return
                emulator.ugv.obey(json.loads(urllib.parse.parse_qs(query)["json"][0]))
                answer = emulator.ugv.info().encode()
                self.send_response(200)
                self.send_header("Content-Length", str(len(answer)))
                self.end_headers()
                self.wfile.write(answer)
                # Unplugged means that open connections end, too.
                self.close_connection = emulator._server is not self.server

            def log_message(self, *_: object) -> None:
                pass

        http.server.ThreadingHTTPServer.allow_reuse_address = True
        self._server = http.server.ThreadingHTTPServer(("127.0.0.1", self._port), Handler)
        self._server.daemon_threads = True
        self._port = self._server.server_address[1]
        threading.Thread(target=self._server.serve_forever, args=(0.02,), daemon=True).start()

    def unplug(self) -> None:
        server, self._server = self._server, None  # type: ignore[assignment]
        server.shutdown()
        server.server_close()

    def close(self) -> None:
        self._closing = True
        self._thread.join()
        if self._server is not None:
            self.unplug()

    def _watch(self) -> None:
        while not self._closing:
            time.sleep(0.005)
            self.ugv.watch()
