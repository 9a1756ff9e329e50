"""Reads every message with Python's numbers and MessagePack alone, by the tables of docs/wire.md.

Written from that page. It imports nothing of Mapweave, so that what the page leaves out shows.
"""

import hashlib
import math
import re
import struct
import zlib
from functools import cache
from pathlib import Path
from typing import Any

import msgpack
import numpy as np

ROOT = Path(__file__).parents[2]
TABLES = ROOT / "hybridmap" / "landmarks.npz"
ROW = re.compile(r"^\| `([A-Z]\w+)` \| (`\w+`\??: .*) \|$", re.MULTILINE)
FIELD = re.compile(r"`(\w+)`(\??): (.+?)(?: \(.*\))?")
EDGE_KINDS = ("", "mapped", "turned", "driven", "loop", "merged")
DTYPES = {"f4": "<f4", "f8": "<f8", "i8": "<i8", "u1": "u1", "b1": "?"}


def schema() -> dict[str, dict[str, tuple[bool, str]]]:
    """Fields of every class of the page: whether one may be left out, and its type."""
    classes: dict[str, dict[str, tuple[bool, str]]] = {}
    for name, cell in ROW.findall((ROOT / "docs" / "wire.md").read_text(encoding="utf-8")):
        assert name not in classes, f"{name} is described twice"
        classes[name] = {}
        for field in split(cell, "; "):
            match = FIELD.fullmatch(field)
            assert match is not None, f"{name}: {field}"
            classes[name][match[1]] = (bool(match[2]), match[3])
    return classes


def split(text: str, separator: str) -> list[str]:
    """Pieces of a text between separators that are in no bracket."""
    pieces, depth, begin = [], 0, 0
    for k, letter in enumerate(text):
        depth += (letter in "([") - (letter in ")]")
        if depth == 0 and text.startswith(separator, k):
            pieces.append(text[begin:k])
            begin = k + len(separator)
    return [*pieces, text[begin:]]


@cache
def frequencies() -> dict[str, Any]:
    """The tables, as lists: an archive of arrays reads the file again whenever it is asked."""
    with np.load(TABLES) as tables:
        return {name: tables[name].tolist() for name in ("codes", "shares", "cells")}


@cache
def axes() -> tuple[list[float], list[list[float]], float]:
    """What descriptors are projected with: their mean, a row of axes for each entry, and the step."""
    with np.load(TABLES) as tables:
        return tables["mean"].tolist(), tables["basis"].tolist(), float(tables["step"])


class Landmarks:
    """Reads packed landmarks bit by bit."""

    def __init__(self, packed: bytes) -> None:
        head = struct.unpack_from("<BBHHHHH", packed)
        self.version, self.flags, self.count, self.least_x, self.reach_x, self.least_y, self.reach_y = head
        (check,) = struct.unpack("<I", packed[-4:])
        assert zlib.crc32(packed[:-4]) == check
        self.text = "".join(f"{byte:08b}" for byte in packed[12:-4])
        self.at = 0

    def take(self, count: int) -> int:
        self.at += count
        return int(self.text[self.at - count : self.at] or "0", 2)

    def rows(self) -> tuple[list[int], int]:
        if not self.flags & 1:
            return [0] * self.count, self.reach_y.bit_length()
        low = 0
        while 2 << low <= (self.reach_y + 1) // max(self.count, 1):
            low += 1
        high, step = [], 0
        for _ in range(self.count + (self.reach_y >> low)):
            if self.take(1):
                high.append(step)
            else:
                step += 1
        return high, low

    def pop(self, lane: int, frequencies: list[int]) -> int:
        slot, symbol = self.states[lane] % 4096, 0
        while slot >= frequencies[symbol]:
            slot -= frequencies[symbol]
            symbol += 1
        self.states[lane] = frequencies[symbol] * (self.states[lane] // 4096) + slot
        self.missing.append(lane)
        return symbol

    def refill(self) -> None:
        for lane in self.missing:
            while self.states[lane] < 1 << self.size:
                self.states[lane] = 2 * self.states[lane] + self.take(1)
        self.missing = []

    def read(self, width: int, height: int) -> list[tuple[float, float, list[int], float, float]]:
        """(x, y, code, depth, sigma) of each landmark, for an image of that size."""
        tables, everyone = frequencies(), range(self.count)
        high, low = self.rows()
        self.size = max(12, (((self.reach_x + 1) << low) - 1).bit_length())
        self.states = [(1 << self.size) + self.take(self.size) for _ in everyone]
        self.missing: list[int] = []
        codes: list[list[int]] = [[] for _ in everyone]
        for k in range(32):
            for lane in everyone:
                codes[lane].append(self.pop(lane, tables["codes"][k]))
            self.refill()
        depths, sigmas = [math.nan] * self.count, [math.nan] * self.count
        if self.flags & 2:
            shares = [self.pop(lane, tables["shares"]) for lane in everyone]
            self.refill()
            known = [lane for lane in everyone if shares[lane]]
            cells = {lane: self.pop(lane, tables["cells"]) for lane in known}
            self.refill()
            for lane in known:
                share = 0.002 * math.exp((shares[lane] - 1) / 8)
                fine = max(0, math.ceil(math.log2(0.75 / share)))
                step = self.pop(lane, [1 << (12 - fine)] * (1 << fine))
                q = cells[lane] * 2**fine + step + 0.5
                depths[lane] = 0.01 * math.exp(q / 4 / 2**fine)
                sigmas[lane] = depths[lane] * share
            self.refill()
        seeds = [state - (1 << self.size) for state in self.states]
        assert set(self.text[self.at :]) <= {"0"}
        assert len(self.text) - self.at < 8
        x = [self.least_x + (seed >> low) for seed in seeds]
        y = [self.least_y + (h << low) + seed % (1 << low) for h, seed in zip(high, seeds, strict=True)]
        scale = 8
        while scale > 65535 / (2 * max(width, height)):
            scale //= 2
        return [
            (x[n] / scale - width // 2, y[n] / scale - height // 2, codes[n], depths[n], sigmas[n])
            for n in everyone
        ]  # fmt: skip


def landmarks(data: bytes, camera: dict[str, Any]) -> dict[str, Any]:
    """Columns."""
    rows = Landmarks(data).read(camera["width"], camera["height"])
    columns = {"pixels": [[x, y] for x, y, *_ in rows], "codes": [row[2] for row in rows]}
    if data[1] & 2:
        columns |= {"depths": [row[3] for row in rows], "depth_sigmas": [row[4] for row in rows]}
    return columns


def message(data: bytes) -> dict[str, Any]:
    """Fields of a message, without its version."""
    fields: dict[str, Any] = msgpack.unpackb(data)
    assert fields.pop("v") == 1
    return fields


def numbers(kind: str, data: bytes) -> tuple[Any, ...]:
    """All of the bytes as little-endian numbers of one kind."""
    return struct.unpack(f"<{len(data) // struct.calcsize('<' + kind)}{kind}", data)


def uncertain_pose(data: bytes) -> dict[str, Any]:
    x, y, heading, xx, xy, xh, yy, yh, hh = numbers("f", data)
    return {"mean": [x, y, heading], "covariance": [[xx, xy, xh], [xy, yy, yh], [xh, yh, hh]]}


def camera(data: bytes) -> dict[str, Any]:
    names = ("width", "height", "fx", "fy", "cx", "cy", "mount_height", "mount_forward")
    return dict(zip(names, struct.unpack("<HH6d", data), strict=True))


def distances(data: bytes, reach: float) -> list[float]:
    return [reach if byte == 255 else min(byte / 254, 0.99999) * reach for byte in data]


def ranges(data: bytes) -> dict[str, Any]:
    count, reach = (len(data) - 2) // 3, numbers("H", data[:2])[0] / 1000
    bearings = [step * 1e-4 for step in numbers("h", data[2 : 2 + 2 * count])]
    return {"bearings": bearings, "distances": distances(data[2 + 2 * count :], reach), "reach": reach}


def segment(data: bytes, sensors: int, reach: float) -> dict[str, Any]:
    count = len(data) // (8 + sensors)
    columns = [numbers("h", data[2 * count * k : 2 * count * (k + 1)]) for k in range(4)]
    rows = [data[8 * count + sensors * k :][:sensors] for k in range(count)]
    return {
        "ages": [age * 0.01 for age in columns[0]],
        "node_from_robot": [[x * 1e-3, y * 1e-3, h * 1e-4] for x, y, h in zip(*columns[1:], strict=True)],
        "distances": [distances(row, reach) for row in rows],
    }


def body(data: bytes) -> dict[str, Any]:
    """Of a change."""
    fields = message(data)
    element = fields["i"]
    if fields["k"] in (2, 4):
        return {"id": element}
    if fields["k"] == 1:
        lens = camera(fields["c"])
        seen = ranges(fields.get("g", b"\0\0"))
        return {
            "id": element, "stamp_ns": fields["t"], "map_from_robot": uncertain_pose(fields["p"]),
            "camera": lens, "landmarks": landmarks(fields["m"], lens), "clock": fields.get("z", ""),
            "radius": fields.get("r", 0) / 1000, "ranges": seen,
            "segment": segment(fields.get("u", b""), len(seen["bearings"]), seen["reach"]),
        }  # fmt: skip
    a, b = ([*element[:2], end] if isinstance(end, int) else end for end in (fields["a"], fields["b"]))
    packed = fields.get("h", b"\1")
    indices = numbers("BH"[packed[0] - 1], packed[1:])
    half = len(indices) // 2
    shared = [list(pair) for pair in zip(indices[:half], indices[half:], strict=True)]
    return {
        "id": element, "a": a, "b": b, "a_from_b": uncertain_pose(fields["p"]),
        "kind": EDGE_KINDS[fields["w"]], "shared": shared, "evidence": fields.get("x", {}),
    }  # fmt: skip


class Plain:
    """Reads a message of a kind.

    Attributes:
        classes: see `schema`.
        read: classes that have been read.
    """

    def __init__(self) -> None:
        self.classes, self.read = schema(), set[str]()

    def decode(self, kind: str, data: bytes) -> Any:
        """The value of a message; of a question or an answer that is no class by the name in the vectors."""
        if kind in self.classes:
            return self.value(f"`{kind}`", message(data))
        return getattr(self, "_" + kind.replace(" ", "_"))(data)

    def value(self, form: str, plain: Any) -> Any:
        """A value of a type of the page.

        Raises:
            ValueError: it is none.
        """
        if form.endswith(" or nil"):
            return None if plain is None else self.value(form.removesuffix(" or nil"), plain)
        if len(choices := split(form, " or ")) > 1:
            return self._any(choices, plain)
        match form.split(" ", 2):
            case ["text"]:
                return _of(plain, str)
            case ["integer"]:
                return _of(plain, int)
            case ["number"]:
                return _of(plain, float, int)
            case ["boolean"]:
                return _of(plain, bool)
            case ["bytes"]:
                return _of(plain, bytes).hex()
            case ["pose"]:
                return self.value("[number, number, number]", plain)
            case ["node", "id"]:
                return self.value("[text, integer, integer]", plain)
            case ["map", "id"]:
                return self.value("[text, integer]", plain)
            case ["pose", "with", "covariance"]:
                return uncertain_pose(_of(plain, bytes))
            case ["camera"]:
                return camera(plain)
            case ["node" | "edge" | "change"]:
                return body(plain)
            case ["array", kind]:
                return self._array(kind, *plain)
            case ["one", "of", words]:
                if plain not in words.split(", "):
                    raise ValueError(f"{plain} is not {form}")
                return plain
            case ["list", "of", inner]:
                return [self.value(inner, element) for element in _of(plain, list)]
            case ["map", "of", inner]:
                key, content = split(inner, " to ")
                items = plain.items() if isinstance(plain, dict) else plain
                return [[self.value(key, k), self.value(content, v)] for k, v in items]
        if form.startswith("["):
            forms = split(form[1:-1], ", ")
            if len(forms) != len(_of(plain, list)):
                raise ValueError(f"{plain} is not {form}")
            return [self.value(one, element) for one, element in zip(forms, plain, strict=True)]
        return self._class(form.strip("`"), plain)

    def _any(self, choices: list[str], plain: Any) -> Any:
        for choice in choices:
            try:
                return self.value(choice, plain)
            except ValueError:
                continue
        raise ValueError(f"{plain} is none of {choices}")

    def _class(self, name: str, plain: Any) -> Any:
        fields = self.classes[name]
        if unknown := set(_of(plain, dict)) - set(fields):
            raise ValueError(f"{name} has {unknown}, which the page does not name")
        if missing := {field for field, (optional, _) in fields.items() if not optional} - set(plain):
            raise ValueError(f"{name} lacks {missing}")
        value = {field: self.value(fields[field][1], element) for field, element in plain.items()}
        self.read.add(name)
        return value

    def _array(self, kind: str, given: str, size: list[int], data: bytes) -> Any:
        assert given == kind
        return np.frombuffer(data, DTYPES[kind]).reshape(size).tolist()

    # Messages with keys of one letter, and bytes.

    def _change(self, data: bytes) -> Any:
        fields = message(data)
        content = body(fields["b"])
        return {"map": content["id"][:2], "sequence": fields["q"], "stamp_ns": fields["t"], "body": content}

    def _attachment(self, data: bytes) -> Any:
        sequence, log = numbers("Q", data)
        return {"sequence": sequence, "log_id": log}

    def _beacon(self, data: bytes) -> Any:
        fields = message(data)
        return {"log_id": fields["l"], "newest": fields["q"], "acknowledged": fields.get("a", {})}

    def _log_question(self, data: bytes) -> Any:
        fields = message(data)
        return {"first": fields["f"], "last": fields["q"], "stored": self._stored(fields)}

    def _log_answer(self, data: bytes) -> Any:
        fields = message(data)
        changes = [[sequence, change.hex()] for sequence, change in fields["c"]]
        return {"log_id": fields["l"], "first": fields["f"], "covered": fields["q"], "changes": changes}

    def _acknowledgement(self, data: bytes) -> Any:
        fields = message(data)
        refusals = [{"sequence": sequence, "reason": reason} for sequence, reason in fields.get("r", [])]
        return {
            "map": fields["m"], "log_id": fields["l"], "watermark": fields["q"], "refusals": refusals,
            "store": fields.get("s", 0),
            "status_period": fields.get("p", 0.0),
            "stored": self._stored(fields),
        }  # fmt: skip

    def _stored(self, fields: dict[str, Any]) -> Any:
        return dict(zip(("sequence", "crc"), fields["d"], strict=True)) if "d" in fields else None

    def _newest_map(self, data: bytes) -> Any:
        fields = message(data)
        return {"epoch": fields["e"], "pruned": fields.get("g", False)}

    def _kept_nodes(self, data: bytes) -> Any:
        fields = message(data)
        return {"epoch": fields["e"], "numbers": fields["n"]}

    def _merged_poses(self, data: bytes) -> Any:
        fields, placed = message(data), []
        for frame, epoch, ids, packed in fields["w"]:
            flat = numbers("f", packed)
            for k, number in enumerate(ids):
                where = {"frame": frame, "merged_from_node": list(flat[3 * k : 3 * k + 3])}
                placed.append([[fields["a"], epoch, number], where])
        gone = [[fields["a"], epoch, number] for epoch, ids in fields["g"] for number in ids]
        return {
            "run": fields["l"],
            "after": fields["p"],
            "sequence": fields["q"],
            "placed": placed,
            "gone": gone,
        }

    def _view(self, data: bytes) -> Any:
        fields = message(data)
        lens = camera(fields["camera"])
        return landmarks(fields["features"], lens) | {"camera": lens, "near": fields.get("near")}

    def _flat_record(self, data: bytes) -> Any:
        return message(data)["s"]

    def _refusal(self, data: bytes) -> Any:
        reason, zero, pause = data.removeprefix(b"refused: ").partition(b"\0")
        return {"error": reason.decode(), "retry_after": numbers("f", pause)[0] if zero else 0.0}

    def _step_question(self, data: bytes) -> Any:
        fields = message(data)
        return {"sequence": fields["q"], "command": dict(zip(("forward", "turn"), fields["c"], strict=True))}

    def _step_answer(self, data: bytes) -> Any:
        fields = message(data)
        image = None
        if "i" in fields:
            assert fields["encoding"] == "raw"
            image = np.frombuffer(fields["i"], np.uint8).reshape(fields["s"]).tolist()
        return {
            "stamp_ns": fields["t"], "odometry": dict(zip(("forward", "turn"), fields["u"], strict=True)),
            "image": image, "proximity": fields["r"], "bumped": fields["b"],
            "battery": fields.get("battery"), "kidnapped": fields.get("k", False),
        }  # fmt: skip

    def _descriptor(self, data: bytes) -> Any:
        """The code of a SIFT descriptor, a byte an entry."""
        mean, basis, step = axes()
        total = max(sum(data), 1e-12)
        root = [math.sqrt(entry / total) - mean[i] for i, entry in enumerate(data)]
        coordinates = [sum(root[i] * basis[i][k] for i in range(128)) for k in range(32)]
        return [min(max(round(y / step) + 32, 0), 63) for y in coordinates]

    def _map_file(self, data: bytes) -> Any:
        magic, version, length = struct.unpack_from("<8sIQ", data)
        assert (magic, version, length) == (b"MAPWEAVE", 1, len(data) - 20 - 32)
        assert hashlib.sha256(data[:-32]).digest() == data[-32:]
        return self.value("`MapFile`", message(data[20:-32]))


def _of(plain: Any, *kinds: type) -> Any:
    if type(plain) not in kinds:
        raise ValueError(f"{plain!r} is no {kinds[0].__name__}")
    return plain
