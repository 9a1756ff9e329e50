"""Images of floor plans, and map.yaml files of Nav2."""

import hashlib
import tracemalloc
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapweave.hybridmap.errors import InvalidFile, InvalidValue
from mapweave.hybridmap.pose import Pose2
from mapweave.storage.nav2_map import read_nav2_map
from mapweave.storage.plan_image import _on_white, check_plan_png, plan_file, plan_pixels, read_plan_file

GREY = np.arange(48, dtype=np.uint8).reshape(6, 8) * 5
COLOUR = np.dstack([GREY, 255 - GREY, GREY // 2])


@pytest.mark.parametrize(
    ("suffix", "pixels"),
    [*((suffix, GREY) for suffix in (".png", ".pgm", ".bmp", ".jpg")),
     *((suffix, COLOUR) for suffix in (".png", ".ppm", ".bmp", ".jpg"))],
)  # fmt: skip
def test_any_image_is_kept_as_a_png(tmp_path, suffix: str, pixels: np.ndarray):
    path = tmp_path / f"plan{suffix}"
    cv2.imwrite(str(path), pixels)
    expected = cv2.imread(str(path), cv2.IMREAD_COLOR)[:, :, ::-1]
    kept = read_plan_file(path)
    assert kept.image.sha256 == hashlib.sha256(kept.png).hexdigest()
    assert (kept.image.width, kept.image.height, kept.image.file) == (8, 6, path.name)
    assert np.array_equal(in_colour(plan_pixels(kept.png)), expected)
    checked = check_plan_png(kept.png)
    assert (checked.sha256, checked.width, checked.height) == (kept.image.sha256, 8, 6)
    negative = read_plan_file(path, negate=True)
    assert np.array_equal(255 - in_colour(plan_pixels(negative.png)), expected)


def in_colour(pixels: np.ndarray) -> np.ndarray:
    return np.dstack([pixels] * 3) if pixels.ndim == 2 else pixels


def test_what_is_transparent_is_white_and_16_bits_become_8():
    clear = np.dstack(
        [np.full((2, 3), 40, np.uint8)] * 3 + [np.array([[0, 255, 0], [255, 0, 255]], np.uint8)]
    )
    found = plan_pixels(plan_file(cv2.imencode(".png", clear)[1].tobytes()).png)
    assert np.array_equal(found[:, :, 0], [[255, 40, 255], [40, 255, 40]])
    deep = (GREY.astype(np.uint16) << 8) + 17
    for suffix in (".png", ".pgm"):
        found = plan_pixels(plan_file(cv2.imencode(suffix, deep)[1].tobytes()).png)
        assert np.array_equal(found, GREY)


def test_a_transparent_colour_of_a_palette_is_white():
    """Black lines on a transparent ground were black on black."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return len(data).to_bytes(4, "big") + kind + data + zlib.crc32(kind + data).to_bytes(4, "big")

    head = (3).to_bytes(4, "big") + (1).to_bytes(4, "big") + bytes([8, 3, 0, 0, 0])
    png = b"\x89PNG\r\n\x1a\n" + b"".join([
        chunk(b"IHDR", head), chunk(b"PLTE", bytes(6)), chunk(b"tRNS", bytes([0, 255])),
        chunk(b"IDAT", zlib.compress(bytes([0, 0, 1, 0]))), chunk(b"IEND", b""),
    ])  # fmt: skip
    assert in_colour(plan_pixels(plan_file(png).png))[0, :, 0].tolist() == [255, 0, 255]


def test_a_long_plan_is_refused_before_it_is_decoded(monkeypatch):
    long = bytearray(cv2.imencode(".png", GREY)[1].tobytes())
    long[16:24] = (20_001).to_bytes(4, "big") + (2_000).to_bytes(4, "big")
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    with pytest.raises(InvalidValue, match="at most 20000 px a side"):
        plan_file(bytes(long))


def test_a_large_transparent_plan_takes_no_more_memory_than_its_pixels():
    """A PNG of 50 kB with 50 million pixels took 1.8 GB: all of it as numbers of four bytes, twice."""
    rows = 4096
    image = np.zeros((rows, 1000, 4), np.uint8)
    image[:, :, 3] = np.arange(rows)[:, None] % 256
    image[:, :, :3] = 200
    tracemalloc.start()
    white = _on_white(image)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    expected = np.rint(200 * (np.arange(rows) % 256) / 255.0 + 255.0 - np.arange(rows) % 256)
    assert np.abs(white.astype(float) - expected[:, None, None]).max() <= 1.0
    assert peak < 1.5 * white.nbytes


def test_no_image_and_too_large_ones_are_refused(tmp_path):
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(40))
    (tmp_path / "b.png").write_text("a page")
    huge = bytearray(cv2.imencode(".png", GREY)[1].tobytes())
    huge[16:24] = (60_000).to_bytes(4, "big") * 2
    (tmp_path / "c.png").write_bytes(huge)
    for name, words in {
        "a.png": "damaged",
        "b.png": "no JPEG, PNG, PGM or BMP file",
        "c.png": "too large",
        "none.png": "No such file",
    }.items():
        with pytest.raises(InvalidFile, match=words):
            read_plan_file(tmp_path / name)
    with pytest.raises(InvalidValue, match="20000 px a side"):
        plan_file(cv2.imencode(".png", np.zeros((1, 20_001), np.uint8))[1].tobytes())
    for data in (b"", b"\x89PNG\r\n\x1a\n", cv2.imencode(".jpg", GREY)[1].tobytes(), bytes(huge)):
        with pytest.raises(InvalidValue):
            check_plan_png(data)


MAP = "image: plan.pgm\nresolution: 0.05\norigin: [-10.0, -5.5, 0.25]\n"


def test_a_map_of_nav2_is_read(tmp_path):
    path = tmp_path / "map.yaml"
    path.write_text(
        f"# made by map_saver\n{MAP}negate: 1\noccupied_thresh: 0.65\nfree_thresh: 0.196\nmode: trinary\n"
    )
    found = read_nav2_map(path)
    assert found.image == tmp_path / "plan.pgm" and found.resolution == 0.05 and found.negate
    assert found.origin == Pose2(-10.0, -5.5, 0.25) and found.free_thresh == 0.196
    path.write_text(MAP.replace("plan.pgm", "/maps/plan.pgm"))
    assert read_nav2_map(path).image == Path("/maps/plan.pgm")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "has no fields"),
        ("image: [", "is no YAML"),
        ("- 1\n- 2\n", "has no fields"),
        (MAP.replace("image", "picture"), "has no `image:`"),
        (MAP.replace("0.05", "-1"), "give metres in a pixel"),
        (MAP.replace("0.05", "fine"), "resolution 'fine': give a number"),
        (MAP.replace("resolution: 0.05\n", ""), "has no `resolution:`"),
        (MAP.replace("0.05", ".nan"), "give a number"),
        (MAP.replace(", 0.25", ""), r"give \[x, y, yaw\]"),
        (MAP.replace("0.25", ".inf"), r"give \[x, y, yaw\]"),
        (f"{MAP}negate: 2\n", "negate 2: give 0 or 1"),
        (f"{MAP}free_thresh: 0.9\n", "free < occupied"),
        (f"{MAP}a: !!python/object/apply:os.system [ls]\n", "is no YAML"),
        ("[" * 600, "is no YAML"),
        (f"{MAP}a: !!bool maybe\n", "is no YAML"),
        (f"{MAP}a: !!int ''\n", "is no YAML"),
        (MAP.replace("0.05", "1" + 400 * "0"), "resolution 1000.*: give a number"),
        (MAP.replace("0.25", "1" + 400 * "0"), r"give \[x, y, yaw\]"),
        (MAP.replace("plan.pgm", "~not-a-user/plan.pgm"), "image '~not-a-user/plan.pgm'"),
        ("a" * 10_000, "10000 bytes"),
    ],
)
def test_what_is_no_map_yaml_is_refused_in_one_line(tmp_path, text: str, words: str):
    path = tmp_path / "map.yaml"
    path.write_text(text)
    with pytest.raises(InvalidFile, match=words) as refused:
        read_nav2_map(path)
    assert "\n" not in str(refused.value) and str(path) in str(refused.value)
    with pytest.raises(InvalidFile, match="cannot be read"):
        read_nav2_map(tmp_path)


@pytest.mark.parametrize("field", ["origin", "resolution", "negate", "free_thresh"])
def test_aliases_of_aliases_fill_no_memory(tmp_path, field: str):
    """600 bytes of lists of lists, of which the text would take terabytes."""
    names = ["x", *(f"*a{k}" for k in range(13))]
    levels = [f"a{k}: &a{k} [{', '.join(9 * [name])}]\n" for k, name in enumerate(names)]
    path = tmp_path / "map.yaml"
    path.write_text(f"{''.join(levels)}image: a.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n")
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*(line for line in lines if not line.startswith(field)), f"{field}: *a13\n"]))
    with pytest.raises(InvalidFile, match=field) as refused:
        read_nav2_map(path)
    assert len(str(refused.value)) < 500
