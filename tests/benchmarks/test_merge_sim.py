"""Merging in the simulator: rays against the renderer, wrong joins, and failing runs are reported."""

import json
import signal
import sys
from dataclasses import asdict

import numpy as np
import pytest
from rich.console import Console

from benchmarks.merge_sim import benchmark as merge_sim
from benchmarks.merge_sim.benchmark import Failure, figures, measure, outcome, summary
from benchmarks.merge_sim.run import MergeRun, false_merges
from benchmarks.merge_sim.views import lengths, views_shared
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Pose2
from mapweave.sim.camera import WEBCAM
from mapweave.sim.renderer import Renderer
from mapweave.sim.texture import Texture
from mapweave.sim.world import PanelSet, World
from mapweave.sim.worlds.catalog import make_world

RUN = MergeRun("office", 3, 60, 3, 1, 0.02, 9, 0, 0, 40, 8, 10, 8, 7, 0.7, 150.0, 90.0)


@pytest.fixture(scope="module")
def world() -> World:
    return make_world("warehouse", 4, rows=1, bays=2)


def test_rays_agree_with_the_renderer(world: World) -> None:
    """Each panel in a grey of its own: the pixel says which one a ray must meet, and that how far away."""
    panels = PanelSet.of(world.panels)
    count = len(panels.corner)
    assert count <= 250
    grey = PanelSet(panels.corner, panels.along, panels.down, [Texture.plain(k) for k in range(count)])
    rng, agreed, compared = np.random.default_rng(0), 0, 0
    for _ in range(5):
        pose = world.plan.random_free_pose(rng, 0.4)
        turn = np.eye(3)
        turn[:2, :2] = pose.rotation
        image = Renderer(WEBCAM, 255).render(grey, turn, np.array([pose.x, pose.y, 0.0]))
        rows, columns = (part.ravel() for part in np.mgrid[7:240:15, 7:320:15])
        tips = WEBCAM.back_project(np.stack([columns, rows], axis=1), np.ones(len(rows)))
        eye = np.array([pose.x, pose.y, WEBCAM.mount_height])
        ways = tips @ turn.T + [pose.x, pose.y, 0.0] - eye
        result = lengths(panels, eye, ways)
        drawn = image[rows, columns].astype(int)
        meets = drawn < count
        assert (result[~meets] > 50.0).mean() > 0.95 if (~meets).any() else True
        normals = np.cross(panels.along, panels.down)[drawn[meets]]
        expected = ((panels.corner[drawn[meets]] - eye) * normals).sum(axis=1) / (ways[meets] * normals).sum(
            axis=1
        )
        agreed += int((abs(result[meets] / expected - 1.0) < 1e-6).sum())
        compared += int(meets.sum())
    # At edges of panels the renderer blends, and greys that are blended are other panels'.
    assert compared > 1000 and agreed / compared > 0.97


def test_views_of_one_thing_share_landmarks(world: World) -> None:
    panels = PanelSet.of(world.panels)
    rng = np.random.default_rng(1)
    here = world.plan.random_free_pose(rng, 0.6)
    near, back = here @ Pose2(0.1, 0.0, 0.05), here @ Pose2(0.0, 0.0, np.pi)
    shared = views_shared(panels, WEBCAM, [here, near, back])
    assert np.allclose(shared, shared.T) and np.allclose(np.diag(shared), 1.0)
    assert shared[0, 1] > 0.6 and shared[0, 2] == 0.0
    wanted = views_shared(panels, WEBCAM, [here, near, back], least=0.5)
    assert np.allclose(wanted, np.where(shared >= 0.5, shared, 0.0))


def test_views_along_a_wall_from_both_ends_share_no_side() -> None:
    """A wall of 20 m along x, and two cameras that look at each other along it."""
    corner, along, down = (
        np.array([[-10.0, 0.5, 1.5]]),
        np.array([[20.0, 0.0, 0.0]]),
        np.array([[0, 0, -1.5]]),
    )
    panels = PanelSet(corner, along, down, [Texture.plain(90)])
    if (lengths(panels, np.array([0.0, 0.0, 0.3]), np.array([[0.0, 1.0, 0.0]])) > 50.0).all():
        panels = PanelSet(corner + along, -along, down, [Texture.plain(90)])
    poses = [Pose2(-4.0, 0.0, 0.3), Pose2(4.0, 0.0, np.pi - 0.3), Pose2(-3.6, 0.0, 0.3)]
    any_side, one_side = (
        views_shared(panels, WEBCAM, poses, most_angle=angle) for angle in (np.pi, np.pi / 4)
    )
    assert any_side[0, 1] > 0.3 and one_side[0, 1] < 0.05
    assert one_side[0, 2] == pytest.approx(any_side[0, 2], abs=0.05) and one_side[0, 2] > 0.3


def test_objects_in_between_occlude() -> None:
    """Two cameras on both sides of a wall look the same way: they show nothing in common."""
    rooms = make_world("twins", 0)
    panels = PanelSet.of(rooms.panels)
    east = Pose2(1.0, 2.0, 0.0)
    shared = views_shared(panels, WEBCAM, [east, Pose2(6.0, 2.0, 0.0)])
    assert shared[0, 1] == 0.0


def test_maps_that_are_joined_wrongly_are_counted() -> None:
    rng = np.random.default_rng(2)
    truth = {
        NodeId(agent, 1, k): Pose2.from_vector(rng.uniform([0, 0, -3], [9, 9, 3]))
        for agent in "abc"
        for k in range(6)
    }
    merged_from_world = Pose2(3.0, -2.0, 1.0)
    right = {node: (0, merged_from_world @ pose) for node, pose in truth.items()}
    assert false_merges(right, truth) == 0
    shift = Pose2(1.8, 0.0, 0.0)
    moved = {n: (0, merged_from_world @ (shift @ truth[n] if n.agent == "c" else truth[n])) for n in truth}
    assert false_merges(moved, truth) == 2
    apart = {n: (int(n.agent == "c"), pose) for n, (_, pose) in moved.items()}
    assert false_merges(apart, truth) == 0
    near = Pose2(0.3, 0.0, 0.0)
    close = {n: (0, merged_from_world @ (near @ truth[n] if n.agent == "c" else truth[n])) for n in truth}
    assert false_merges(close, truth) == 0


def test_a_failed_or_killed_run_is_reported() -> None:
    text = json.dumps(asdict(RUN))
    assert outcome("office", 3, 0, f"noise\n{text}\n", "") == RUN
    for status, out, words, reason in (
        (-signal.SIGKILL, "", "", "killed by signal 9"),
        (1, "", "a warning\noffice, seed 3: no room\n", "no room"),
        (1, "", "", "status 1"),
        (0, "", "", "nothing that can be read"),
        (0, '{"scenario": "office"}', "", "nothing that can be read"),
    ):
        failure = outcome("office", 3, status, out, words)
        assert isinstance(failure, Failure) and reason in failure.reason
    values = summary(7, ["office", "warehouse"], [RUN, Failure("warehouse", 7000, "was killed by signal 9")])
    assert values["runs"] == {"office": 1, "warehouse": 0}
    assert values["merged_ate_m_median"] == {"office": 0.02, "warehouse": None}
    assert values["false_merges"] == {"office": 0, "warehouse": None}
    assert values["link_recall"]["office"] == pytest.approx(0.2)
    assert [item["reason"] for item in values["failed"]] == ["was killed by signal 9"]
    json.dumps(values, allow_nan=False)


@pytest.mark.slow
def test_runs_are_processes_and_all_are_accounted_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """A scenario that cannot be built beside one that there is not: each is one line, nothing hangs."""
    wrong = {
        "none": ("no-such-scenario",),
        "small": ("twin-rooms", "--set", "world.length=0.1"),
    }
    monkeypatch.setattr(merge_sim, "SCENARIOS", wrong)
    results = measure(["none", "small"], 1, 0, 2, Console(file=sys.stderr, quiet=True))
    assert [type(result) for result in results] == [Failure, Failure]
    assert isinstance(results[0], Failure) and "no scenario 'no-such-scenario'" in results[0].reason
    assert isinstance(results[1], Failure) and "twins: length must be a number, 2.5 to" in results[1].reason


def test_median_and_sums_over_runs() -> None:
    other = MergeRun("office", 4, 60, 3, 2, 0.04, 5, 1, 1, 20, 4, 0, 0, 0, None, 150.0, 80.0)
    values = figures([RUN, other])
    assert values["merged_ate_m_median"] == pytest.approx(0.03)
    assert values["components"] == 1.5 and values["whole"] == 0.5
    assert values["false_merges"] == 1 and values["false_links"] == 1
    assert values["link_recall"] == pytest.approx(12 / 60) and values["place_recall"] == 0.7
    assert values["link_recall_one_side"] == pytest.approx(0.7) and values["verified_one_side"] == 0.8
