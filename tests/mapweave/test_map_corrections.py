"""Corrections of a map from Python: what they leave is what the shell's commands leave in a file."""

from collections.abc import Callable
from pathlib import Path

import pytest

import mapweave
from mapweave import EdgeKind, MapFile, read_map_file
from mapweave.cli import main
from mapweave.hybridmap.change import EdgePut

NAMES = "r0.1", "r1.1"


def decided(file: MapFile) -> tuple[object, ...]:
    """What is joined and where it lies, and the record without the times at which people decided."""
    links = [edge for edge in file.changes if isinstance(edge, EdgePut) and edge.edge.kind is EdgeKind.MERGED]
    return (
        {node: (component, pose.mean) for node, (component, pose) in file.poses.items()},
        sorted((link.edge.a, link.edge.b) for link in links),
        sorted((refusal.a, refusal.b) for refusal in file.refused),
        [(one.about, one.holds, one.who, one.because) for one in file.constraints],
        # The words of an event end with the time.
        [(one.kind, one.words.split(" on 20")[0]) for one in file.history],
    )


def by_shell(path: Path, *words: str) -> MapFile:
    """What a command leaves in a file."""
    assert main(["map", *words, "--by", "anna", "--because", "two rooms", "--map", str(path)]) == 0
    return read_map_file(path)


def test_python_and_shell_leave_the_same_file(joined: Path, tmp_path):
    path = tmp_path / "shell.mapweave"
    path.write_bytes(joined.read_bytes())
    room = mapweave.open(joined, by="anna")
    assert len(room.explain_maps(*NAMES)) == 1 and room.explain_maps(*NAMES)[0].joined
    node = room.nodes.ids[0]
    corrections: dict[tuple[str, ...], Callable[[], str]] = {
        ("unmerge", *NAMES): lambda: room.unlink(*NAMES, "two rooms"),
        ("retire", node): lambda: room.retire(node, because="two rooms"),
        ("undo", "1"): lambda: room.undo(1, "two rooms"),
        ("undo", "2"): lambda: room.undo(room.constraints()[1], "two rooms"),
    }
    for words, correct in corrections.items():
        assert correct()
        room.save(tmp_path / "python.mapweave")
        saved = read_map_file(tmp_path / "python.mapweave")
        assert decided(saved) == decided(by_shell(path, *words)), words
        # The map that is looked at is that of the file.
        assert {*room.nodes.ids} == {str(node) for node in saved.poses}
        assert room.hash == mapweave.open(tmp_path / "python.mapweave").hash
    assert room.explain_maps(*NAMES)[0].joined
    assert [one.who for one in room.constraints()] == ["anna"] * 4


def test_a_map_is_changed_in_memory_until_it_is_saved(joined: Path):
    room, before = mapweave.open(joined), joined.read_bytes()
    assert room.unlink(*NAMES, check=True).startswith("only checked")
    assert not room.constraints()
    room.unlink(*NAMES)
    assert not room.explain_maps(*NAMES)[0].joined
    assert joined.read_bytes() == before and not mapweave.open(joined).constraints()


def test_a_link_by_hand_is_held_against_images_and_geometry(joined: Path):
    room, ends = mapweave.open(joined, by="anna"), ("r0.1.1", "r1.1.7")
    there, here = (room.pose(end).mean for end in ends)
    with pytest.raises(mapweave.Refused, match="do not show one place: "):
        room.link(*ends)
    true = there.inverse() @ here
    with pytest.raises(mapweave.Refused):
        room.link(*ends, true @ mapweave.Pose2(2.0), "I was there")
    assert not room.constraints()
    assert "linked by hand by anna" in room.link(*ends, true, "I was there")
    kinds = [d["kind"] for d in room.graph().get_edge_data(*ends, default={}).values()]
    assert "merged" in kinds and "linked by hand by anna" in room.explain(*ends).reason
    room.undo(1)
    assert not room.graph().has_edge(*ends)


def test_what_is_not_there_is_refused(joined: Path):
    room = mapweave.open(joined)
    for wrong in (lambda: room.undo(1), lambda: room.retire("r7.1"), lambda: room.unlink("r0.1", "r7.1")):
        with pytest.raises(mapweave.MapweaveError):
            wrong()
    assert not room.constraints()
