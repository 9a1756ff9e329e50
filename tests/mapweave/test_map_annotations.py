"""What is said about a map from Python: it leaves in a file what the shell's commands leave."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import mapweave
from mapweave import MapFile, MapId, read_map_file
from mapweave.cli import main
from mapweave.editable_map import EditableMap
from mapweave.exit_status import NO
from mapweave.hybridmap.floor_plan import PlanImage
from mapweave.storage.plan_image import plan_file
from synthetic.maps import looked_around, write_store

FIRST, THIRD = "r0.1.1", "r1.1.3"
CORNERS = ((0, 0), (4, 0), (4, 3), (0, 3))
BEGIN, END = "2030-03-01 14:00 UTC", "2030-03-01 15:00 UTC"


def png() -> bytes:
    """The image of a plan, (60, 80) px."""
    encoded = cv2.imencode(".png", np.full((60, 80), 200, np.uint8))[1].tobytes()
    return plan_file(encoded, "flat.png").png


def pairs_at(room: mapweave.FileMap) -> list[tuple[str, float, float]]:
    """Four places about the third node, and their pixels at 0.2 m."""
    at = room.pose(THIRD).mean
    return [(f"{at.x + x:.3f},{at.y + y:.3f}", 5.0 + 5 * x, 45.0 - 5 * y) for x, y in CORNERS]


def called(image: PlanImage) -> PlanImage:
    """The image with the name of its file, which the shell knows."""
    return replace(image, file="flat.png")


def said(file: MapFile) -> tuple[object, ...]:
    """The record without the times at which people said it, where nodes lie, and the images of plans."""
    return (
        [(one.kind, one.name, one.body, one.removed, one.who, one.because) for one in file.annotations],
        file.poses.keys(),
        [(component, pose.mean) for component, pose in file.poses.values()],
        file.images,
    )


def by_shell(path: Path, *words: str) -> MapFile:
    """What a command leaves in a file."""
    assert main([*words, "--by", "anna", "--because", "as seen", "--map", str(path)]) == 0
    return read_map_file(path)


def test_python_and_shell_leave_the_same_file(joined: Path, tmp_path, capsys):
    path, picture = tmp_path / "shell.mapweave", tmp_path / "flat.png"
    path.write_bytes(joined.read_bytes())
    picture.write_bytes(png())
    room, why = mapweave.open(joined, by="anna"), "as seen"
    before = room.pose(THIRD).mean
    pairs = pairs_at(room)
    clicked = [word for at, u, v in pairs for word in ("--pair", f"{at}={u},{v}")]
    closed = ("close", "kitchen", "--radius", "0.5", "--name", "wet", "--from", BEGIN, "--until", END)
    steps: dict[tuple[str, ...], Callable[[], str]] = {
        ("place", "add", "kitchen", THIRD): lambda: room.place("kitchen", THIRD, because=why),
        ("place", "add", "hall", "--corners", "0,0", "1,0", "1,1", "--near", "kitchen"): lambda: room.place(
            "hall", corners=[(0, 0), (1, 0), (1, 1)], near="kitchen", because=why
        ),
        closed: lambda: room.close_way(
            "wet", place="kitchen", radius=0.5, begin=BEGIN, end=END, because=why
        ),
        ("close", FIRST, "r0.1.3", "--name", "way"): lambda: room.close_way(
            "way", edge=(FIRST, "r0.1.3"), because=why
        ),
        ("prefer", "kitchen", "--radius", "1", "--name", "carpet"): lambda: room.prefer(
            "carpet", 0.5, place="kitchen", radius=1.0, because=why
        ),
        ("floor", "ground", "kitchen"): lambda: room.floor("kitchen", "ground", because=why),
        ("map", "portal", "add", "gate", FIRST, "kitchen", "--kind", "door"): lambda: room.portal(
            "gate", FIRST, "kitchen", "door", because=why
        ),
        ("plan", "add", str(picture), *clicked, "--metres-per-pixel", "0.2"): lambda: room.plan(
            "flat", called(room.put_plan_image(png())), pairs, metres_per_pixel=0.2, because=why
        ),
        ("map", "pin", THIRD, "12.5,-3,90"): lambda: room.pin(
            THIRD, mapweave.Pose2(12.5, -3.0, np.pi / 2), because=why
        ),
        ("reopen", "wet"): lambda: room.withdraw("closure", "wet", why),
        ("map", "pin", "kitchen", "--undo"): lambda: room.withdraw("pin", THIRD, why),
        ("plan", "remove", "flat"): lambda: room.withdraw("plan", "flat", why),
        ("map", "retire", FIRST): lambda: room.retire(FIRST, because=why),
        ("place", "remove", "hall"): lambda: room.withdraw("place", "hall", why),
    }  # fmt: skip
    for words, say in steps.items():
        capsys.readouterr()
        expected = by_shell(path, *words)
        printed = capsys.readouterr().out
        # The second may be in the next minute.
        words_of_both = [re.sub(r"\d\d:\d\d UTC", "then", one) for one in (say(), printed)]
        assert words_of_both[0] in words_of_both[1], words
        room.save(tmp_path / "python.mapweave")
        assert said(read_map_file(tmp_path / "python.mapweave")) == said(expected), words
        # The map that is looked at is that of the file.
        assert room.hash == mapweave.open(tmp_path / "python.mapweave").hash
        if words[:2] == ("map", "pin"):
            pinned = "--undo" not in words
            there = mapweave.Pose2(12.5, -3.0) if pinned else before
            assert room.pose(THIRD).mean.distance(there) < 1e-6
            assert abs(room.nodes.x[list(room.nodes.ids).index(THIRD)] - there.x) < 1e-6
        if words[0] == "plan":
            assert [plan.name for plan in room.plans().plans] == ["flat"] * (words[1] == "add")
            assert len(room.content.images) == (words[1] == "add")
    # All but a retirement, which is a correction, and keeps them.
    assert len(room.annotations().made) == len(steps) - 1


def test_what_is_said_holds_at_once_in_memory_and_not_in_the_file(joined: Path):
    room, before = mapweave.open(joined), joined.read_bytes()
    assert room.route(FIRST, "r0.1.3").found
    assert room.place("kitchen", THIRD, check=True).startswith("only checked, nothing is changed: place")
    assert not room.annotations().made
    room.place("kitchen", THIRD)
    assert str(room.resolve("kitchen").found[0].node) == THIRD
    room.close_way("all", node=FIRST, radius=50.0)
    assert not room.route(FIRST, "r0.1.3").found
    room.withdraw("closure", "all")
    assert room.route(FIRST, "r0.1.3").found
    # A correction keeps what was said.
    room.unlink("r0.1", "r1.1")
    assert [one.name for one in room.annotations().made] == ["kitchen", "all", "all"]
    assert joined.read_bytes() == before and not mapweave.open(joined).annotations().made


def test_links_between_floors_fall_with_the_next_correction(joined: Path):
    room = mapweave.open(joined)
    room.floor(FIRST, "ground")
    with pytest.raises(mapweave.Refused):
        room.floor(THIRD, "first")
    room.floor(THIRD, "first", because="up the stairs")
    assert room.explain_maps("r0.1", "r1.1")[0].joined
    room.retire("r0.1.3")
    assert not room.explain_maps("r0.1", "r1.1")[0].joined


def test_a_store_stays_as_it_is(tmp_path):
    store = write_store(tmp_path / "s0.sqlite", looked_around((MapId("r0", 1), MapId("r1", 1)), seed=6))
    before = store.read_bytes()
    room = mapweave.open(store, by="anna")
    room.pin(THIRD, mapweave.Pose2(1.0, 2.0, 0.0), because="as seen")
    room.save(tmp_path / "python.mapweave")
    pinned = ("map", "pin", THIRD, "1,2,0", "-o", str(tmp_path / "shell.mapweave"))
    assert main([*pinned, "--by", "anna", "--because", "as seen", "--map", str(store)]) == 0
    saved = read_map_file(tmp_path / "python.mapweave")
    assert said(saved) == said(read_map_file(tmp_path / "shell.mapweave"))
    assert saved.poses and room.pose(THIRD).mean.distance(mapweave.Pose2(1.0, 2.0)) < 1e-6
    assert store.read_bytes() == before


def test_a_robots_own_map_is_pinned():
    """Its file has no poses: they follow from its edges."""
    (changes,) = looked_around((MapId("r0", 1),), seed=8).values()
    alone = mapweave.FileMap(MapFile("agent", "r0.1", tuple(changes)))
    alone.pin(FIRST, mapweave.Pose2(5.0, 6.0, 0.0))
    assert alone.pose(FIRST).mean.distance(mapweave.Pose2(5.0, 6.0)) < 1e-6
    assert not alone.content.poses


def test_what_is_refused_has_the_reason_of_the_shell(joined: Path, tmp_path, capsys):
    path = tmp_path / "parted.mapweave"
    parted = mapweave.open(joined)
    parted.unlink("r0.1", "r1.1")
    parted.save(path)
    before, room = path.read_bytes(), mapweave.open(path)
    refused: dict[tuple[str, ...], tuple[str, Callable[[], str]]] = {
        ("place", "add", "attic", "r0.1.99"): ("has no node 99", lambda: room.place("attic", "r0.1.99")),
        ("close", FIRST, "r1.1.7", "--name", "way"): (
            "no edge joins r0.1.1 and r1.1.7",
            lambda: room.close_way("way", edge=(FIRST, "r1.1.7")),
        ),
        ("reopen", "wet"): ("there is no closure wet", lambda: room.withdraw("closure", "wet")),
        ("map", "pin", "attic"): ("'attic' is no place of this map", lambda: room.pin("attic")),
        ("floor", "ground", "attic"): ("'attic' is no place", lambda: room.floor("attic", "ground")),
    }
    for words, (reason, say) in refused.items():
        capsys.readouterr()
        assert main([*words, "--map", str(path)]) == NO, words
        shell = capsys.readouterr().err
        with pytest.raises(mapweave.Refused) as error:
            say()
        assert reason in str(error.value) and str(error.value) in shell, words
    with pytest.raises(mapweave.MapweaveError, match="is over already"):
        room.close_way("past", node=FIRST, radius=1.0, end="2001-01-01 UTC")
    with pytest.raises(mapweave.Refused, match="put it first"):
        room.plan("flat", PlanImage("0" * 64, 80, 60), pairs_at(room))
    with pytest.raises(mapweave.MapweaveError, match="PNG"):
        room.put_plan_image(b"no image")
    assert not room.annotations().made and path.read_bytes() == before


def test_a_file_has_the_methods_of_a_fleet():
    own = [name for name in vars(EditableMap) if not name.startswith("_")]
    assert {"place", "close_way", "prefer", "floor", "portal", "pin", "plan", "withdraw"} <= {*own}
    for kind in (mapweave.FileMap, mapweave.Fleet):
        assert issubclass(kind, EditableMap)
