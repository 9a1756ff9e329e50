"""Optimising as a map grows: Mapweave's steps and GTSAM's iSAM2, with the same links and no false one.

A fleet in a building (`synthetic.building`) has mapped most of it. Then four robots go on, a node each
in every step, with all links to what is there. Both are told the same measurements and begin a new node at
the same guess. A step is all that it takes to know every posture again.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass, replace
from typing import Any, Protocol

import gtsam
import numpy as np
from numpy.typing import NDArray
from rich.progress import Progress
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from hybridmap.pose import Array
from hybridmap.recognising.pose_arrays import compose_poses, inverse_poses
from merge.graph.posegraph import ANCHOR_SIGMA
from merge.incremental.factors import Factors
from merge.incremental.relaxing import RelaxSettings, relax
from merge.incremental.settings import StepSettings
from synthetic.building import (
    LINK_SIGMAS,
    LOOKS,
    TURN_SIGMAS,
    WALK_SIGMAS,
    Building,
)

NODES_A_MAP = 100
ACTIVE = 4
"""Robots that go on mapping."""
STEPS = 40
LOOSE_SIGMA = 1.0
"""m and rad, how loosely iSAM2 holds each map's first node: it refuses maps that nothing ties yet."""
Figures = dict[str, float]


@dataclass(frozen=True, eq=False)
class Growth:
    """What is measured, and when.

    Attributes:
        factors: all measurements, between rows of all nodes.
        since: (M,) the step with which each measurement comes; 0 is what is there at first.
        nodes: (N,) the same of nodes.
        guesses: (N,) of a node that comes, the row of the node beside which it is put, by `steps`.
        steps: (N, 3) m, m, rad, how it stands there.
        start: (N, 3) m, m, rad, where to begin with those that are there at first.
    """

    factors: Factors
    since: NDArray[np.int64]
    nodes: NDArray[np.int64]
    guesses: NDArray[np.int64]
    steps: Array
    start: Array

    @staticmethod
    def draw(nodes: int, seed: int) -> Growth:
        """Of a building with so many nodes, in hundreds."""
        robots = nodes // NODES_A_MAP
        building = Building.draw(robots, NODES_A_MAP, seed)
        rng = np.random.default_rng([seed, 7])
        truth = building.truth.reshape(-1, 3)
        rows = np.arange(nodes).reshape(robots, NODES_A_MAP)
        came = np.zeros((robots, NODES_A_MAP), np.int64)
        came[:ACTIVE, NODES_A_MAP - STEPS :] = np.arange(1, STEPS + 1)
        pairs = building.pairs(np.ones(rows.shape, np.bool_))
        links = np.array([[rows[int(n.agent[1:]), n.number // 2] for n in pair] for pair in pairs])
        links = links[np.abs(links[:, 0] - links[:, 1]) > 2]
        own = np.stack([rows[:, :-1].ravel(), rows[:, 1:].ravel()], axis=1)
        walks = (np.arange(1, NODES_A_MAP) % LOOKS == 0)[None] * np.ones((robots, 1), bool)
        sigmas = np.concatenate(
            [
                np.where(walks.ravel()[:, None], WALK_SIGMAS, TURN_SIGMAS),
                np.broadcast_to(LINK_SIGMAS, (len(links), 3)),
            ]
        )
        a, b = np.concatenate([own, links]).T
        means = compose_poses(inverse_poses(truth[a]), truth[b])
        means = compose_poses(means, rng.normal(0.0, sigmas))
        weights = np.zeros((len(a), 3, 3))
        weights[:, [0, 1, 2], [0, 1, 2]] = sigmas**-2.0
        guesses = np.maximum(rows - 1, 0).ravel()
        steps = np.zeros((nodes, 3))
        steps[own[:, 1]] = means[: len(own)]
        return Growth(
            Factors(a, b, means, weights, np.zeros(len(a), np.bool_)),
            np.maximum(came.ravel()[a], came.ravel()[b]),
            came.ravel(),
            guesses,
            steps,
            truth,
        )

    def part(self, step: int) -> Factors:
        """What comes with a step."""
        return self.factors.take(self.since == step, np.arange(len(self.nodes)))


class Solver(Protocol):
    """Optimises step by step."""

    def take(self, new: NDArray[np.int64], guesses: Array, part: Factors) -> Array:
        """New nodes with guesses and new measurements; (N, 3) where all nodes are then."""


class Mapweave:
    """As `merge.incremental.steps` does: around what is new, and everything when a hundredth has come."""

    def __init__(self, nodes: int) -> None:
        """No measurements yet."""
        self._means = np.zeros((nodes, 3))
        self._parts: list[Factors] = []
        self._rough = 0
        self._how = StepSettings()

    def take(self, new: NDArray[np.int64], guesses: Array, part: Factors) -> Array:
        """See `Solver`."""
        self._means = self._means.copy()
        self._means[new] = guesses
        self._parts.append(part)
        self._rough += len(part)
        factors = Factors.together(self._parts, [(0, 0)] * len(self._parts))
        touched, how = np.unique(np.concatenate([part.a, part.b])), replace(self._how.relax, step=1e-4)
        if self._rough > self._how.optimise_share * len(factors):
            self._rough = 0
            touched = np.unique(np.concatenate([factors.a, factors.b]))
            how = RelaxSettings(least=len(touched))
        ties = sparse.coo_matrix(
            (np.ones(len(factors)), (factors.a, factors.b)), shape=(len(self._means),) * 2
        )
        # A map that begins may not be tied to the others yet: one node of each piece is held.
        pieces = connected_components(ties, directed=False)[1]
        held = np.unique(pieces, return_index=True)[1]
        self._means, _ = relax(factors, self._means, held, touched, np.inf, how)
        return self._means


class Isam2:
    """GTSAM's incremental smoothing (Kaess et al., IJRR 2012)."""

    def __init__(self, nodes: int, threshold: float, skip: int) -> None:
        """No measurements yet.

        Args:
            nodes: there will be.
            threshold: of a node's move, m or rad, from which it is linearised anew,
            skip: at every so many updates.
        """
        parameters = gtsam.ISAM2Params()
        parameters.setRelinearizeThreshold(threshold)
        parameters.relinearizeSkip = skip
        self._isam = gtsam.ISAM2(parameters)
        self._nodes = nodes
        self._means = np.zeros((nodes, 3))

    def take(self, new: NDArray[np.int64], guesses: Array, part: Factors) -> Array:
        """See `Solver`."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        first = not self._means.any()
        if first:
            hold(graph, new, guesses)
        for row, guess in zip(new.tolist(), guesses, strict=True):
            values.insert(row, gtsam.Pose2(*guess))
        add_between(graph, part)
        self._isam.update(graph, values)
        if first:
            for _ in range(5):
                self._isam.update()
        estimate = self._isam.calculateEstimate()
        for row in estimate.keys():  # noqa: SIM118 - GTSAM's values are no mapping
            pose = estimate.atPose2(row)
            self._means[row] = pose.x(), pose.y(), pose.theta()
        return self._means.copy()


def hold(graph: Any, rows: NDArray[np.int64], poses: Array) -> None:
    """Hold the first node, and every other map's first one loosely.

    Args:
        graph: of GTSAM.
        rows: (K,) of nodes.
        poses: (K, 3) m, m, rad, where they are held.
    """
    for row, pose in zip(rows.tolist(), poses, strict=True):
        if row % NODES_A_MAP == 0:
            noise = gtsam.noiseModel.Isotropic.Sigma(3, LOOSE_SIGMA if row else ANCHOR_SIGMA)
            graph.add(gtsam.PriorFactorPose2(row, gtsam.Pose2(*pose), noise))


def add_between(graph: Any, part: Factors) -> None:
    """Put measurements into a GTSAM graph."""
    for a, b, mean, weight in zip(part.a.tolist(), part.b.tolist(), part.means, part.weights, strict=True):
        noise = gtsam.noiseModel.Gaussian.Information(weight)
        graph.add(gtsam.BetweenFactorPose2(a, b, gtsam.Pose2(*mean), noise))


def batch(growth: Growth, start: Array) -> float:
    """Chi-square at GTSAM's batch optimum."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    hold(graph, np.zeros(1, np.int64), start[:1])
    add_between(graph, growth.factors)
    for row, pose in enumerate(start):
        values.insert(row, gtsam.Pose2(*pose))
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values)
    return 2.0 * float(graph.error(optimizer.optimize()))


def stepping(nodes: int, seed: int, progress: Progress) -> dict[str, Figures]:
    """Figures of each solver: ms of the processor a step, and how far it ends from the batch optimum.

    Args:
        nodes: when all are there, in hundreds, 400 or more.
        seed: of the building.
        progress: told how far it is.
    """
    growth = Growth.draw(nodes, seed)
    solvers: dict[str, Solver] = {
        "mapweave": Mapweave(nodes),
        "isam2": Isam2(nodes, 0.1, 10),
        "isam2_exact": Isam2(nodes, 1e-3, 1),
    }
    task = progress.add_task(f"steps, {nodes} nodes", total=(STEPS + 1) * len(solvers))
    found: dict[str, Figures] = {}
    best = batch(growth, growth.start)
    for name, solver in solvers.items():
        means, took, off = np.zeros((nodes, 3)), [], 0.0
        for step in range(STEPS + 1):
            new = np.flatnonzero(growth.nodes == step)
            guesses = growth.start[new]
            if step:
                guesses = compose_poses(means[growth.guesses[new]], growth.steps[new])
            part = growth.part(step)
            began = time.process_time()
            means = solver.take(new, guesses, part)
            took.append(1e3 * (time.process_time() - began))
            progress.advance(task)
        off = 2.0 * growth.factors.cost(means, np.inf) / best
        found[name] = {
            "ms_per_step_median": round(statistics.median(took[1:]), 2),
            "ms_per_step_p95": round(float(np.percentile(took[1:], 95)), 2),
            "ms_first": round(took[0], 1),
            "cost_ratio": round(off, 6),
        }
    return found
