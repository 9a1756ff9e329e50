"""`mapweave info`: what there is comes first, and all that is missing is listed."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mapweave.cli import main


def facts_of(capfd: pytest.CaptureFixture[str], *arguments: object) -> dict[str, Any]:
    assert main(["info", *map(str, arguments), "--json"]) == 0
    facts: dict[str, Any] = json.loads(capfd.readouterr().out)
    assert main(["info", *map(str, arguments)]) == 0
    lines = capfd.readouterr().out
    assert all(f"missing: {words}" in lines for words in facts["missing"])
    # "missing: no images", "missing: does not say what camera it is": what is there is not missing.
    assert not any(words.startswith(("no ", "does not ")) for words in facts["missing"])
    return facts


def test_everything_that_is_missing_is_listed_with_its_option(tmp_path, capfd):
    (tmp_path / "image_0").mkdir()
    for k in range(3):
        cv2.imwrite(str(tmp_path / "image_0" / f"{k}.png"), np.full((48, 64), 90, np.uint8))
    (tmp_path / "times.txt").write_text("0\n1\n2\n")
    (tmp_path / "calib.txt").write_text("P0: 60 0 32 0 0 60 24 0 0 0 1 0\n")
    facts = facts_of(capfd, tmp_path)
    assert (facts["images"], facts["seconds"], facts["width"], facts["height"]) == (3, 2.0, 64, 48)
    assert facts["focal_px"] is None and facts["driven_m"] is None
    camera, odometry = facts["missing"]
    assert "--camera-height METRES" in camera and "--odometry FILE" in odometry
    assert len(facts_of(capfd, tmp_path, "--camera-height", 1.65)["missing"]) == 1


def test_a_folder_without_camera_and_odometry_is_described(recording: Path, capfd):
    (recording / "odometry.csv").unlink()
    (recording / "camera.toml").unlink()
    facts = facts_of(capfd, recording)
    assert facts["images"] == 3 and (facts["width"], facts["height"]) == (64, 48)
    assert "--camera FILE" in facts["missing"][0] and "--odometry FILE" in facts["missing"][1]


def test_a_first_image_that_cannot_be_read_is_damage(recording: Path, capfd):
    (recording / "images" / "0.png").write_bytes(b"no image")
    facts = facts_of(capfd, recording)
    assert facts["images"] == 3 and not facts["missing"]
    assert "0.png: not an image that can be read" in facts["damage"][0]


def test_a_bag_without_images_is_described_by_its_topics(tmp_path, capfd):
    from rosbags.rosbag2 import StoragePlugin, Writer

    from mapweave.wire.ros2.messages import typestore

    kind, store = "std_msgs/msg/Empty", typestore()
    with Writer(tmp_path / "drive", version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        opened = writer.add_connection("/tick", kind, typestore=store)
        for second in range(4):
            message = store.types[kind](structure_needs_at_least_one_member=0)
            writer.write(opened, second * 10**9, store.serialize_cdr(message, kind))
            if not second:
                once = writer.add_connection("/once", kind, typestore=store)
                writer.write(once, 0, store.serialize_cdr(message, kind))
    facts = facts_of(capfd, tmp_path / "drive")
    assert (facts["images"], facts["seconds"]) == (0, 3.0)
    counts = {"/once": 1, "/tick": 4}
    assert facts["topics"] == [{"name": name, "type": kind, "count": n} for name, n in counts.items()]
    assert main(["info", str(tmp_path / "drive")]) == 0
    printed = capfd.readouterr().out
    assert "/once (std_msgs/msg/Empty), 1 message\n" in printed
    assert "(std_msgs/msg/Empty), 4 messages\n" in printed
    assert facts["missing"][0].startswith("images (") and "--odometry FILE" in facts["missing"][1]


def test_a_camera_that_can_hardly_be_right_is_named(recording: Path, tmp_path, capfd):
    assert not facts_of(capfd, recording)["notes"]
    camera = recording / "camera.toml"
    right = camera.read_text()
    for line, words in (("cx = 310", "cx = 310 is far from the middle"), ("fx = 0.6", "field of view 178")):
        key = line.split()[0]
        kept = [one for one in right.splitlines() if not one.startswith(key)]
        camera.write_text("\n".join([*kept, line, ""]))
        assert words in " ".join(facts_of(capfd, recording)["notes"])
        assert main(["replay", str(recording), "--offline", "--data", str(tmp_path / "maps")]) == 0
        assert f"camera: {line.split(' =')[0]} = " in capfd.readouterr().out


def test_images_without_times_are_said_to_have_none(recording: Path, tmp_path, capfd):
    """Ten images a second were reported as if the recording said so."""
    assert facts_of(capfd, recording)["images_per_second"] == 10.0
    (recording / "times.txt").unlink()
    facts = facts_of(capfd, recording)
    assert facts["images_per_second"] is facts["longest_gap_s"] is facts["seconds"] is None
    (times,) = facts["missing"]
    assert "times of the images: write times.txt" in times
    assert facts["notes"] == ["no times.txt: ten images a second are assumed"]
    assert main(["replay", str(recording), "--offline", "--data", str(tmp_path / "maps")]) == 0
    assert facts["notes"][0] in capfd.readouterr().out
