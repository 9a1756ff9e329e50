"""Map files: what is written is read, and nothing else is."""

import struct
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.hybridmap.errors import InvalidFile, InvalidValue
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.storage.map_file import MapFile, pack_map_file, read_map_file, unpack_map_file, write_map_file
from mapweave.wire.codec import encode_body


@pytest.fixture
def content(some: SimpleNamespace) -> MapFile:
    node = some.node(30)
    here = PoseGaussian.from_sigmas(Pose2(1.5, -2.5, 0.25), 0.5, 0.25)
    changes = (NodePut(node), NodePut(some.node(2, 16)), EdgePut(some.edge(2)))
    return MapFile("merged", "three rooms", changes, {node.id: (4, here)})


def test_written_values_are_read(tmp_path, content: MapFile):
    path = tmp_path / "a.mapweave"
    write_map_file(path, content)
    back = read_map_file(path)
    assert (back.kind, back.title) == ("merged", "three rooms")
    assert [encode_body(body) for body in back.changes] == [encode_body(body) for body in content.changes]
    assert {node: (c, p.mean) for node, (c, p) in back.poses.items()} == {
        node: (c, p.mean) for node, (c, p) in content.poses.items()
    }
    again = tmp_path / "b.mapweave"
    write_map_file(again, back)
    assert again.read_bytes() == path.read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.mapweave", "b.mapweave"], (
        "nothing is left beside"
    )


@settings(max_examples=100)
@given(where=st.floats(0, 1, exclude_max=True), change=st.integers(1, 255))
def test_any_changed_byte_is_noticed(tmp_path_factory, some: SimpleNamespace, where: float, change: int):
    data = bytearray(pack_map_file(MapFile("agent", "t", (NodePut(some.node(5)),))))
    data[int(where * len(data))] ^= change
    path = tmp_path_factory.getbasetemp() / "changed.mapweave"
    path.write_bytes(data)
    with pytest.raises(InvalidFile, match=r"changed\.mapweave") as error:
        read_map_file(path)
    assert "\n" not in str(error.value)


def test_any_truncation_is_noticed(tmp_path, some: SimpleNamespace):
    data = pack_map_file(MapFile("agent", "t", (NodePut(some.node(5)),)))
    path = tmp_path / "short.mapweave"
    for length in range(len(data)):
        path.write_bytes(data[:length])
        with pytest.raises(InvalidFile, match=r"short.mapweave: is (truncated|not a Mapweave)"):
            read_map_file(path)
    path.write_bytes(data + b"\0")
    with pytest.raises(InvalidFile, match="1 bytes too many"):
        read_map_file(path)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "is not a Mapweave map file"),
        (b"\x89PNG\r\n\x1a\n" + b"\0" * 100, "is not a Mapweave map file"),
        (b"SQLite format 3\0" + b"\0" * 100, "is not a Mapweave map file"),
        (struct.pack("<8sIQ", b"MAPWEAVE", 9, 0) + b"\0" * 32, "has format version 9, this program reads 1"),
    ],
)
def test_other_files_are_named(tmp_path, data: bytes, reason: str):
    path = tmp_path / "other"
    path.write_bytes(data)
    with pytest.raises(InvalidFile, match=f"other: {reason}"):
        read_map_file(path)


def test_files_that_cannot_be_opened_are_named(tmp_path, content: MapFile):
    with pytest.raises(InvalidFile, match="nowhere: cannot be read"):
        read_map_file(tmp_path / "nowhere")
    with pytest.raises(InvalidFile, match="cannot be read"):
        read_map_file(tmp_path)
    with pytest.raises(InvalidFile, match="cannot be written"):
        write_map_file(tmp_path / "no folder" / "map", content)


def test_a_file_of_the_other_kind_can_be_refused(tmp_path, content: MapFile):
    path = tmp_path / "merged"
    write_map_file(path, content)
    assert read_map_file(path, "merged").kind == "merged"
    with pytest.raises(InvalidFile, match="of kind merged, not agent"):
        read_map_file(path, "agent")


def test_an_unknown_kind(content: MapFile):
    with pytest.raises(InvalidValue, match="Invalid enum value 'odd'"):
        pack_map_file(MapFile("odd", "", ()))  # type: ignore[arg-type]


def test_a_failed_write_leaves_the_old_file(tmp_path, content: MapFile, some: SimpleNamespace):
    path = tmp_path / "map"
    write_map_file(path, content)
    before = path.read_bytes()
    with pytest.raises(InvalidValue):
        write_map_file(path, MapFile("agent", "line\nbreak", ()))
    assert path.read_bytes() == before
    assert unpack_map_file(before).title == "three rooms"
    assert list(tmp_path.iterdir()) == [path]
