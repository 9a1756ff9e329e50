"""Map files: what opening one works out."""

from __future__ import annotations

import numpy as np
import pytest

from mapweave.mapserver.map_files import map_file_of, merged_of
from mapweave.merge.pose_graph.solved_graph import PoseGraph
from tests.mapserver.stub_services import two_maps


def test_opening_a_map_solves_for_no_covariance_that_is_not_asked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of a map of 20 000 nodes all of them took minutes, before the page or anything else was there."""
    content, before = map_file_of(two_maps()), two_maps().poses
    with monkeypatch.context() as patch:
        patch.setattr(PoseGraph, "_joint", None)
        merged = merged_of(content)
    assert merged.poses.keys() == before.keys()
    for node, placement in merged.poses.items():
        expected = before[node]
        assert placement.component == expected.component
        difference = placement.merged_from_robot.mean.vector - expected.merged_from_robot.mean.vector
        assert np.abs(difference).max() < 1e-3
        assert np.allclose(
            placement.merged_from_robot.covariance,
            expected.merged_from_robot.covariance,
            rtol=0.05,
            atol=1e-9,
        )
