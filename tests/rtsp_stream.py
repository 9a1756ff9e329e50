"""An RTSP server of one camera, over TCP: RFC 2326 (RTSP), RFC 2435 (JPEG in RTP packets)."""

from __future__ import annotations

import base64
import socket
import struct
import threading
from collections.abc import Callable
from contextlib import suppress

SDP = "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=cam\r\nt=0 0\r\nm=video 0 RTP/AVP 26\r\na=control:track1\r\n"
METHODS = "OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN"
PACKET = 1200
"""Bytes of an image in a packet."""


class RtspStream:
    """Serves at `url` until it is closed; each connection gets frames by itself.

    Attributes:
        url: of its only stream, /cam.
        wrong_logins: how often a wrong user name or password came.
    """

    def __init__(self, next_frame: Callable[[], bytes], credentials: str = "", port: int = 0) -> None:
        """Begin to serve.

        Args:
            next_frame: waits for the next frame, as a colour JPEG of multiples of 16 px.
            credentials: USER:PASSWORD that are asked for; empty asks for none.
            port: of the server; 0 takes a free one.
        """
        self._next_frame, self._credentials = next_frame, credentials
        self._closing = threading.Event()
        self.wrong_logins = 0
        self._socket = socket.create_server(("127.0.0.1", port))
        self.place = "{}:{}".format(*self._socket.getsockname())
        self.url = f"rtsp://{self.place}/cam"
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        self._closing.set()
        self._socket.close()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                client, _ = self._socket.accept()
                threading.Thread(target=self._serve, args=(client,), daemon=True).start()

    def _serve(self, client: socket.socket) -> None:
        with client, suppress(OSError), client.makefile("rb") as requests:
            while line := requests.readline().decode():
                method, url, _ = line.split()
                fields = {}
                while (field := requests.readline().decode().strip()) != "":
                    name, _, value = field.partition(":")
                    fields[name.lower()] = value.strip()
                status, extra, body = self._answer(method, url, fields)
                head = f"RTSP/1.0 {status}\r\nCSeq: {fields['cseq']}\r\n{extra}"
                client.sendall(f"{head}Content-Length: {len(body)}\r\n\r\n{body}".encode())
                if method == "PLAY":
                    threading.Thread(target=self._send, args=(client,), daemon=True).start()

    def _answer(self, method: str, url: str, fields: dict[str, str]) -> tuple[str, str, str]:
        """Status, further fields, body."""
        if method == "OPTIONS":
            return "200 OK", f"Public: {METHODS}\r\n", ""
        right = "Basic " + base64.b64encode(self._credentials.encode()).decode()
        if self._credentials and fields.get("authorization") != right:
            self.wrong_logins += "authorization" in fields
            return "401 Unauthorized", 'WWW-Authenticate: Basic realm="cam"\r\n', ""
        if not url.partition("://")[2].partition("/")[2].startswith("cam"):
            return "404 Not Found", "", ""
        if method == "DESCRIBE":
            return "200 OK", "Content-Type: application/sdp\r\n", SDP
        if method == "SETUP":
            return "200 OK", "Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\nSession: 1\r\n", ""
        return "200 OK", "Session: 1\r\n", ""

    def _send(self, client: socket.socket) -> None:
        sequence = time_of_frame = 0
        with suppress(OSError):
            while not self._closing.is_set():
                tables, size, scan = _parts(self._next_frame())
                time_of_frame += 90_000 // 20
                for at in range(0, len(scan), PACKET):
                    last = at + PACKET >= len(scan)
                    head = struct.pack(">BBHII", 0x80, 26 | last << 7, sequence & 0xFFFF, time_of_frame, 7)
                    # Type 1: 4:2:0. Quality 255: the tables are in the first packet.
                    head += struct.pack(">I", at) + bytes([1, 255, size[0] // 8, size[1] // 8])
                    if at == 0:
                        head += struct.pack(">BBH", 0, 0, len(tables)) + tables
                    packet = head + scan[at : at + PACKET]
                    client.sendall(b"$\0" + struct.pack(">H", len(packet)) + packet)
                    sequence += 1


def _parts(jpeg: bytes) -> tuple[bytes, tuple[int, int], bytes]:
    """Quantization tables, (width, height), and the scan of a JPEG."""
    tables, size, at = b"", (0, 0), 2
    while True:
        marker, length = jpeg[at + 1], int.from_bytes(jpeg[at + 2 : at + 4], "big")
        body = jpeg[at + 4 : at + 2 + length]
        at += 2 + length
        if marker == 0xDB:
            tables += b"".join(body[k + 1 : k + 65] for k in range(0, len(body), 65))
        elif marker == 0xC0:
            size = int.from_bytes(body[3:5], "big"), int.from_bytes(body[1:3], "big")
            assert body[7] == 0x22, "the first component is not sampled 2x2"
        elif marker == 0xDA:
            return tables, size, jpeg[at : jpeg.rindex(b"\xff\xd9")]
