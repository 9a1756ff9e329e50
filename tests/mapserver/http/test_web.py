"""HTTP with a real client: answers, refusals as one JSON object, and nothing that brings the server down."""

import json
import math
import re
import socket
import struct
import threading
import time
import tracemalloc
import zlib
from concurrent.futures import Future
from itertools import pairwise

import numpy as np
import pytest

from mapweave.hybridmap.annotation import Annotation, Annotations, Place
from mapweave.hybridmap.errors import Busy
from mapweave.hybridmap.ids import MapId
from mapweave.mapserver.http import web
from mapweave.mapserver.http.web import Web
from tests.mapserver.http.client import ask, post
from tests.mapserver.stub_services import ANSWER, StubServices, picture, two_maps


def test_an_image_in_and_json_out(served: Web, services: StubServices):
    for kind in (".png", ".jpg"):
        status, answer = post(served, body=picture(kind=kind))
        assert status == 200
        assert (answer["certainty"], answer["reason"]) == ("found", ANSWER.reason)
        (place,) = answer["candidates"]
        assert place["node"] == "r0.1.7"
        pose = place["node_from_robot"]
        assert pose["mean"] == pytest.approx([0.5, -0.25, 0.1])
        assert pose["sigma"] == pytest.approx([0.02, 0.02, 0.01])
        assert np.sqrt(np.diag(pose["covariance"])).tolist() == pose["sigma"]
        assert (place["merged_from_robot"], place["inliers"]) == (None, 31)
    assert all(len(view) > 20 for view in services.views)


def test_the_view_of_a_node_is_an_image_and_nothing_else(served: Web, services: StubServices):
    node = next(iter(two_maps().maps[MapId("r0", 1)].nodes))
    status, headers, content = ask(served, "GET", f"/nodes/{node}/view")
    assert status == 404 and json.loads(content) == {"error": "r0 is away, or keeps no views"}
    assert json.loads(ask(served, "GET", f"/nodes/{node}")[2])["view"] is False
    services.images[node] = picture(kind=".jpg")
    status, headers, content = ask(served, "GET", f"/nodes/{node}/view")
    assert status == 200 and content == services.images[node]
    assert headers["Content-Type"] == "image/jpeg" and headers["X-Content-Type-Options"] == "nosniff"
    assert json.loads(ask(served, "GET", f"/nodes/{node}")[2])["view"] is True
    assert ask(served, "GET", "/nodes/r0/view")[0] == 400


def test_a_node_is_asked_for_by_the_name_of_a_place_and_by_a_position(served: Web, services: StubServices):
    merged = two_maps()
    node = next(node for node in merged.poses if node not in merged.superseded)
    services.said = Annotations((Annotation("the kitchen", Place(node), False, "anna", 1),))
    services.images[node] = picture(kind=".jpg")
    at = merged.pose(node)
    for words in ("the%20kitchen", f"{at.x:.3f},{at.y:.3f}"):
        status, _, content = ask(served, "GET", f"/nodes/{words}")
        assert status == 200 and json.loads(content)["node"]["id"] == str(node)
        assert ask(served, "GET", f"/nodes/{words}/view")[2] == services.images[node]
    status, _, content = ask(served, "GET", "/nodes/nowhere")
    assert status == 400 and "'nowhere' is no place of this map" in json.loads(content)["error"]


def test_the_camera_as_it_is_given(served: Web, services: StubServices):
    assert post(served, "?hfov=90&height_m=0.3&forward_m=0.1")[0] == 200
    camera = services.views[-1].camera
    assert (camera.width, camera.height) == (160, 120)
    assert (camera.fx, camera.fy) == pytest.approx((80.0, 80.0))
    assert (camera.cx, camera.cy, camera.mount_height, camera.mount_forward) == (79.5, 59.5, 0.3, 0.1)
    assert post(served, "?fx=100&fy=101&cx=70&cy=60&mount_height=0.5")[0] == 200
    camera = services.views[-1].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.mount_height) == (100, 101, 70, 60, 0.5)
    assert post(served)[0] == 200
    camera = services.views[-1].camera
    assert camera.mount_height == 1.4
    # The longer side of an image of unknown origin, held upright or not.
    assert math.degrees(2 * math.atan(80 / camera.fx)) == pytest.approx(69.4)
    assert post(served, body=picture(120, 160))[0] == 200
    assert services.views[-1].camera.fx == pytest.approx(camera.fx)


def test_a_large_image_is_made_smaller_with_its_camera(served: Web, services: StubServices):
    assert (
        post(served, "?fx=1000&cx=800&cy=600&width=2048&height=1536", picture(2048, 1536, ".jpg"))[0] == 200
    )
    camera = services.views[-1].camera
    assert (camera.width, camera.height) == (1024, 768)
    assert (camera.fx, camera.cx, camera.cy) == pytest.approx((500, 399.75, 299.75))
    # The same camera said for the full size of an image that was sent small.
    assert post(served, "?fx=1000&cx=800&cy=600&width=2048&height=1536", picture(512, 384))[0] == 200
    assert services.views[-1].camera.fx == pytest.approx(250)


def form(*parts: tuple[str, bytes], boundary: str = "frontier") -> tuple[bytes, dict[str, str]]:
    """A form as curl and browsers send it."""
    body = b"".join(
        f'--{boundary}\r\nContent-Disposition: form-data; name="{name}"; filename="x"\r\n'.encode()
        + b"Content-Type: application/octet-stream\r\n\r\n" + content + b"\r\n"
        for name, content in parts
    )  # fmt: skip
    return body + f"--{boundary}--\r\n".encode(), {
        "Content-Type": f"multipart/form-data; boundary={boundary}"
    }


def test_a_form_with_a_camera_file(served: Web, services: StubServices):
    toml = b"width = 160\nheight = 120\nfx = 99.0\nfy = 98.0\ncx = 80\ncy = 60\nheight_m = 0.3\n"
    as_json = json.dumps({"fx": 99.0, "fy": 98.0, "distortion": [0.1, 0, 0, 0, 0]}).encode()
    for camera in (toml, as_json):
        body, headers = form(("image", picture()), ("camera", camera), ("forward_m", b"0.2"))
        assert post(served, body=body, **headers)[0] == 200
        camera_used = services.views[-1].camera
        assert (camera_used.fx, camera_used.fy, camera_used.mount_forward) == (99.0, 98.0, 0.2)
    # An image that holds the boundary's beginning and bare line ends comes whole.
    odd = picture() + b"\r\n--fro\r\n\n\r--\r\n"
    body, headers = form(("image", odd))
    plain = services.views[-1]
    assert post(served, "?fx=99&fy=98", body=body, **headers)[0] == 200
    assert np.array_equal(services.views[-1].codes, plain.codes)


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ("?fx=wide", "fx must be a number, not 'wide'"),
        ("?fx=1e9", "fx must be a number of at most a million, not '1e9'"),
        ("?fx=-5", "focal lengths must be positive"),
        ("?hfov=200", "hfov 200 is no angle of view"),
        ("?hfov=nan", "hfov must be a number"),
        ("?fx=100&hfov=60", "give fx or hfov, not both"),
        ("?fox=100", "no camera value 'fox'; known are width"),
        ("?width=640&height=640", "the image is 160x120 px, but its camera's 640x640"),
        ("?width=0", "the image is 160x120 px"),
        ("?distortion=1,2", "distortion must be five numbers"),
        ("?height_m=1e300", "height_m must be a number"),
    ],
)
def test_cameras_that_cannot_be(served: Web, query: str, words: str):
    status, answer = post(served, query)
    assert status == 400
    assert words in answer["error"]
    assert "\n" not in answer["error"]


def huge_png() -> bytes:
    """The head of an image of 100 000 x 100 000 px."""
    head = b"IHDR" + struct.pack(">IIBBBBB", 100_000, 100_000, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + head + struct.pack(">I", zlib.crc32(head))


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (b"no image", "no JPEG, PNG, PGM or BMP file; convert it to PNG"),
        (b"\xff\xd8", "no JPEG, PNG, PGM or BMP file; convert it to PNG"),
        (b"\xff\xd8\xff\xff\xff\xe0\x00\x00" * 9, "no JPEG, PNG, PGM or BMP file; convert it to PNG"),
        (b"\xff\xd8" + b"\xff\xe0\x00\x02" * 1_000_000, "no JPEG, PNG, PGM or BMP file; convert it to PNG"),
        (b"\xff\xd8" + b"\xff" * 5_000_000, "no JPEG, PNG, PGM or BMP file; convert it to PNG"),
        (picture(kind=".jpg") + b"\xff\xda" * 20, "more than 20 scans"),
        (picture()[:60], "the image is damaged"),
        (huge_png(), "an image of 100000x100000 px is too large"),
        (picture(8, 8), "camera: image size 8x8 is out of range"),
    ],
)
def test_images_that_are_none(served: Web, body: bytes, words: str):
    status, answer = post(served, body=body)
    assert status == 400
    assert words in answer["error"]


@pytest.mark.parametrize(
    ("body", "content_type", "words"),
    [
        (b"", "multipart/form-data", "the form has no boundary"),
        (b"xx", "multipart/form-data; boundary=b", "the form is damaged: "),
        (form(("picture", b"x"))[0], form()[1]["Content-Type"], "no part named image"),
        (form(("image", b"x"))[0][:-4], form()[1]["Content-Type"], "the form is cut off"),
        (form(*[(f"p{k}", b"") for k in range(40)])[0], form()[1]["Content-Type"], "more than 32 parts"),
        (b"--b\r\n\r\nx\r\n--b--", "multipart/form-data; boundary=b", "a part of the form has no name"),
        (form(("image", b"x"), ("camera", b"fx = "))[0], form()[1]["Content-Type"], "neither TOML nor JSON"),
        (
            form(("image", b"x"), ("camera", b"{" * 4000))[0],
            form()[1]["Content-Type"],
            "neither TOML nor JSON",
        ),
        (
            form(("image", picture()), ("camera", b'{"fx": 1%s}' % (400 * b"0")))[0],
            form()[1]["Content-Type"],
            "fx must be a number",
        ),
    ],
    ids=["no-boundary", "no-parts", "no-image", "cut", "many", "no-name", "no-toml", "deep-json", "digits"],
)
def test_forms_that_are_none(served: Web, body: bytes, content_type: str, words: str):
    status, answer = post(served, body=body or b"x", **{"Content-Type": content_type})
    assert status == 400
    assert words in answer["error"]


@pytest.mark.parametrize(
    "camera",
    [
        b"a" + b".a" * 30_000 + b"=1",
        b"[" * 60_000,
        b"fx = [" * 10_000,
        b'{"fx": ' * 9_000,
        b"fx = 1\n" * 9_000,
    ],
    ids=["dots", "brackets", "open-lists", "deep-json", "many-lines"],
)
def test_a_camera_costs_next_to_nothing(served: Web, camera: bytes):
    body, headers = form(("image", picture()), ("camera", camera))
    tracemalloc.start()
    begin = time.monotonic()
    status, answer = post(served, body=body, **headers)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert (status, answer["error"]) == (400, f"camera has {len(camera)} bytes, at most 4096 are read")
    assert peak < 2_000_000 and time.monotonic() < begin + 5.0


@pytest.mark.parametrize(
    "camera", [b"a" + b".a" * 2_000 + b" = 1", b"fx = {a = 1}", b"[camera]\nfx = 1", b"fx\n"]
)
def test_a_camera_is_flat(served: Web, camera: bytes):
    body, headers = form(("image", picture()), ("camera", camera))
    status, answer = post(served, body=body, **headers)
    assert status == 400 and (
        "neither TOML nor JSON" in answer["error"] or "must be a number" in answer["error"]
    )


def test_a_camera_with_remarks(served: Web, services: StubServices):
    toml = b"# phone\r\nfx = 99.0  # px\n\nfy = 1_00\ndistortion = [0.1, -2e-2, 0, 0, 0,]\n"
    body, headers = form(("image", picture()), ("camera", toml))
    assert post(served, body=body, **headers)[0] == 200
    assert (services.views[-1].camera.fx, services.views[-1].camera.fy) == (99.0, 100.0)


def test_a_head_of_a_part_costs_next_to_nothing(served: Web):
    head = b'--b\r\nContent-Disposition: form-data; name="image"' + b"; a*0=b" * 100_000
    begin = time.monotonic()
    status, answer = post(
        served, body=head + b"\r\n\r\nx\r\n--b--", **{"Content-Type": "multipart/form-data; boundary=b"}
    )
    assert status == 400 and answer["error"].startswith("the form is damaged: ")
    assert time.monotonic() < begin + 2.0


@pytest.mark.parametrize(
    ("headers", "words"),
    [
        ({"Host": "evil.example"}, "this server is not 'evil.example'"),
        ({"Host": "evil.example:8080"}, "this server is not 'evil.example:8080'"),
        ({"Host": "127.0.0.1.evil.example"}, "this server is not"),
        ({"Host": ""}, "this server is not 'named'"),
        ({"Origin": "https://evil.example"}, "pages of 'https://evil.example' may not ask here"),
        ({"Origin": "null"}, "pages of 'null' may not ask here"),
        ({"Host": "127.0.0.1:1", "Origin": "http://127.0.0.1:2"}, "pages of 'http://127.0.0.1:2'"),
        ({"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Dest": "image"}, "may not show parts of this server"),
        ({"Sec-Fetch-Site": "same-site", "Sec-Fetch-Dest": "iframe"}, "may not show parts of this server"),
        ({"Sec-Fetch-Site": "cross-site"}, "may not show parts of this server"),
    ],
)
def test_pages_of_other_sites_are_refused(
    served: Web, services: StubServices, headers: dict[str, str], words: str
):
    status, answer = post(served, **headers)
    assert status == 403 and words in answer["error"]
    assert not services.views
    for path in ("/", "/why", "/status", "/history", "/explain", "/nothing"):
        status, _, content = ask(served, "GET", path, headers=headers)
        assert status == 403 and words in json.loads(content)["error"]


@pytest.mark.parametrize(
    ("site", "part"), [("cross-site", "document"), ("same-origin", "script"), ("none", "document")]
)
def test_links_lead_here_and_own_pages_show_own_parts(served: Web, site: str, part: str):
    headers = {"Sec-Fetch-Site": site, "Sec-Fetch-Dest": part}
    assert ask(served, "GET", "/", headers=headers)[0] == 200


@pytest.mark.parametrize(
    "host", ["localhost", "LOCALHOST:8080", "127.0.0.1", "[::1]:8080", socket.gethostname()]
)
def test_own_pages_ask_by_any_name_of_this_machine(served: Web, host: str):
    for headers in (
        {"Host": host},
        {"Host": host, "Origin": f"http://{host}"},
        {"Host": host, "Origin": f"https://{host}"},
    ):
        assert post(served, **headers)[0] == 200


def test_a_busy_server_gives_a_retry_time(served: Web, services: StubServices):
    services.refusal = Busy(1.26)
    status, headers, content = ask(served, "POST", "/relocalize", picture())
    assert (status, headers["Retry-After"]) == (503, "2")
    assert json.loads(content) == {"error": "busy, retry after 1.3 s", "retry_after": 1.26}


def test_a_defect_is_answered_and_logged(served: Web, services: StubServices, caplog):
    services.refusal = ZeroDivisionError("a defect")
    assert post(served) == (500, {"error": "the server failed: a defect"})
    assert "ZeroDivisionError" in caplog.text


def test_the_page_and_the_status(served: Web):
    status, headers, content = ask(served, "GET", "/")
    assert (status, headers["Content-Type"]) == (200, "text/html; charset=utf-8")
    assert b'type="file"' in content
    assert b"http://" not in content and b"https://" not in content, "it works without the internet"
    status, _, content = ask(served, "GET", "/status?x=1")
    assert (status, json.loads(content)) == (200, {"nodes": 12, "summary": "12 nodes"})


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [
        ("GET", "/relocalize", 405),
        ("POST", "/", 405),
        ("GET", "/../etc/passwd", 404),
        ("POST", "/nothing", 404),
        ("DELETE", "/", 405),
        ("BREW", "/", 405),
        ("GET", "/" + "x" * 16_000, 404),
        ("GET", "/" + "x" * 70_000, 400),
        ("GET", "/" + "x" * 900_000, 400),
        ("GET", "/static", 404),
        ("GET", "/static/", 404),
        ("GET", "/static/nothing.js", 404),
        ("GET", "/static/../web.py", 404),
        ("GET", "/static/..%2fweb.py", 404),
        ("GET", "/static/%2e%2e/web.py", 404),
        ("GET", "/static//etc/passwd", 404),
        ("GET", "/static/%2fetc/passwd", 404),
        ("GET", "/static/page.js%00", 404),
        ("POST", "/static/page.js", 405),
    ],
)
def test_missing_pages(served: Web, method: str, path: str, status: int):
    got, headers, content = ask(served, method, path, b"x" if method == "POST" else None)
    assert (got, headers["Content-Type"]) == (status, "application/json")
    assert json.loads(content)["error"]


@pytest.mark.parametrize("pieces", [(), (1,), (60,), (4096, 9000), (16_383,), (16_384,), (16_385,)])
@pytest.mark.parametrize(("size", "status"), [(16_384, 404), (16_385, 400), (70_000, 400)])
def test_a_long_head_is_refused_however_it_arrives(
    served: Web, size: int, status: int, pieces: tuple[int, ...]
):
    frame = "GET /{} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
    request = frame.format("x" * (size - len(frame) + 2)).encode()
    assert len(request) == size
    bounds = [0, *(piece for piece in pieces if piece < size), size]
    with socket.create_connection(("127.0.0.1", served.port), timeout=20) as connection:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        for start, end in pairwise(bounds):
            connection.sendall(request[start:end])
            time.sleep(0.02)
        answer = connection.makefile("rb").readline()
    assert answer.startswith(f"HTTP/1.1 {status} ".encode())


def test_pages_load_nothing_but_files_of_this_server(served: Web):
    for path in ("/", "/why", "/static/page.js", "/static/page.css", "/status", "/nothing"):
        _, headers, content = ask(served, "GET", path)
        assert headers["Content-Security-Policy"].startswith("default-src 'none'; script-src 'self'; ")
        assert (headers["X-Content-Type-Options"], headers["Cache-Control"]) == ("nosniff", "no-store")
        assert headers["Server"] == "Mapweave"
        assert not re.search(rb"<script(?! src=)|<style| on[a-z]+=|javascript:", content)


def test_a_large_map_may_take_longer_than_other_answers(services: StubServices, monkeypatch):
    """Packing 20 000 nodes takes minutes: over HTTP it was given up after 10 s, over Zenoh after 120 s."""
    packed: Future[bytes] = Future()
    monkeypatch.setattr(services, "map_file", lambda: packed, raising=False)
    with Web(("127.0.0.1", 0), services, patience=0.2) as served:
        threading.Timer(1.0, packed.set_result, [b"MAPWEAVE"]).start()
        status, headers, content = ask(served, "GET", "/map")
        assert (status, content) == (200, b"MAPWEAVE") and "merged.mapweave" in headers["Content-Disposition"]
        packed = Future()
        monkeypatch.setattr(web, "PACKING", 0.2)
        status, _, content = ask(served, "GET", "/map")
        words = "the map is not packed after 0.2 s; the server goes on: ask again"
        assert (status, json.loads(content)) == (408, {"error": words})
