"""Photographs of a walk without odometry: images of the first pass are places, those of the second ask.

Depths cannot be had from one image every few metres without a known focal length, so the places are nodes
whose landmarks have none: appearance alone. A candidate is verified by epipolar geometry, which leaves the
camera free in all six directions.
"""

import csv
import math
import re
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from statistics import mode

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.agent.recordings.image_folder import images_of
from mapweave.evaluation.asking_again import LostDrive
from mapweave.evaluation.verdict import JudgedAnswer
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import DeviceError
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Landmarks, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import Certainty, View
from mapweave.mapserver.retrieval.place_index import PlaceIndex
from mapweave.registration.evidence import cells
from mapweave.registration.matching import match
from mapweave.storage.image_file import read_grey
from mapweave.vision.lens import Distortion, Lens
from mapweave.vision.sift import Sift


@dataclass(frozen=True)
class Reference:
    """Which places show what a question shows, by the numbers of their images: from `low` to `high`."""

    best: int
    low: int
    high: int


class Photographs:
    """The images of a folder, cut into two passes by its lap_truth.csv.

    Attributes:
        places: images of the first pass, by number.
        questions: images of the others.
        references: what is right for each question; None where no image of the first pass shows the place.
    """

    def __init__(self, folder: Path) -> None:
        """Read the table.

        Raises:
            DeviceError: a file is missing or wrong.
        """
        path = folder / "lap_truth.csv"
        self.references = _read_references(path)
        numbered = {_number(image): image for image in images_of(folder)}
        missing = sorted(set(self.references) - set(numbered))
        if missing:
            raise DeviceError(f"{path}: there is no image {missing[0]}")
        self.questions = {number: numbered[number] for number in self.references}
        self.places = {n: image for n, image in numbered.items() if n not in self.references}
        if not self.places:
            raise DeviceError(f"{path}: every image is a question, so there is no first pass")


GATE_PX = 2.0
"""Largest distance from an epipolar line."""
LEAST_INLIERS, LEAST_SHARE, LEAST_CELLS = 12, 0.5, 4
"""Matches that agree, as a number and as a share of all; cells of the grid with one, in either image."""
LEAST_EVIDENCE = 20.0
"""How much likelier than chance, nats."""
SAMPLE, TRIES = 7, 2000
"""Pairs that a fundamental matrix is made of; how many such samples are drawn at most."""


def agreeing(node: Node, view: View) -> NDArray[np.int64] | None:
    """Landmarks of a node and features of a view that agree on one fundamental matrix (RANSAC).

    Returns:
        (K, 2) pairs, or None if the view does not show the place.
    """
    pairs = match(node.landmarks.codes, view.codes)
    if len(pairs) < LEAST_INLIERS:
        return None
    node_pixels, view_pixels = node.landmarks.pixels[pairs[:, 0]], view.pixels[pairs[:, 1]]
    _, mask = cv2.findFundamentalMat(node_pixels, view_pixels, cv2.FM_RANSAC, GATE_PX, 0.999, TRIES)
    inside = np.zeros(len(pairs), bool) if mask is None else mask[:, 0].astype(bool)
    count = int(inside.sum())
    if count < max(LEAST_INLIERS, LEAST_SHARE * len(pairs)):
        return None
    if evidence(count, len(pairs), GATE_PX, view.camera.height) < LEAST_EVIDENCE:
        return None
    if min(cells(node_pixels[inside], node.camera), cells(view_pixels[inside], view.camera)) < LEAST_CELLS:
        return None
    inlying_pairs: NDArray[np.int64] = pairs[inside]
    return inlying_pairs


def evidence(inliers: int, matches: int, gate_px: float, height_px: int) -> float:
    """Nats: Chernoff's bound on so many wrong matches near their lines, without those that made the lines."""
    inliers, matches = inliers - SAMPLE, matches - SAMPLE
    chance = 2.0 * gate_px / height_px
    if matches <= 0 or inliers <= chance * matches:
        return 0.0
    share = inliers / matches
    rest = (1.0 - share) * math.log((1.0 - share) / (1.0 - chance)) if share < 1.0 else 0.0
    return matches * (share * math.log(share / chance) + rest) - math.log(TRIES)


def rivals(inliers: Mapping[int, int], together: Callable[[int, int], bool], comparable: float) -> list[int]:
    """The place with most inliers, and one node each of others that come into question as well."""
    order = sorted(inliers, key=lambda name: -inliers[name])
    kept = order[:1]
    for name in order[1:]:
        enough = inliers[name] >= comparable * inliers[order[0]]
        if enough and not any(together(name, earlier) for earlier in kept):
            kept.append(name)
    return kept


def step_of(numbers: Iterable[int]) -> int:
    """By how much the numbers of images that follow each other differ: 5 where every fifth was kept."""
    differences = [after - before for before, after in pairwise(sorted(numbers))]
    return mode(differences) if differences else 1


CANDIDATES = 8
"""Places that are compared with a question."""
APART = 2
"""Places further from each other than so many images are not neighbours."""
COMPARABLE = 0.6
"""With this share of the best place's inliers another place makes the answer ambiguous."""


class AppearanceMap:
    """Places by their appearance alone."""

    def __init__(self, camera: Camera, distortion: Distortion, step: int):
        """Begin with none, for a camera and its lens; `step` of the places' numbers, see `step_of`."""
        self._camera, self._apart = camera, APART * step
        self._sift = Sift(Lens(camera, distortion))
        self._index = PlaceIndex()
        self._nodes: dict[int, Node] = {}

    def add(self, number: int, image: Path) -> None:
        """One more place."""
        view = self._view(image)
        unknown = np.full(len(view), np.nan, np.float32)
        landmarks = Landmarks(view.pixels, view.codes, unknown, unknown)
        nowhere = PoseGaussian(Pose2(), np.zeros((3, 3)))
        self._nodes[number] = Node(NodeId("photo", 1, number), 0, nowhere, self._camera, landmarks)
        self._index.add(self._nodes[number])

    def ask(self, number: int, image: Path, reference: Reference | None) -> JudgedAnswer:
        """Where an image was taken."""
        began = time.perf_counter()
        view = self._view(image)
        extracted = time.perf_counter()
        ranked = [node_id.number for node_id, _ in self._index.query(view, CANDIDATES)]
        certainty, place = self._judge(ranked, view)
        return JudgedAnswer(
            query=str(number),
            expected=reference is not None,
            certainty=certainty,
            place="" if place is None else str(place),
            right=None if place is None else _is_right(place, reference),
            first=_is_right(ranked[0], reference) if ranked else False,
            error_frames=math.nan if place is None or reference is None else abs(place - reference.best),
            extract_ms=1e3 * (extracted - began),
            answer_ms=1e3 * (time.perf_counter() - extracted),
        )

    def _judge(self, ranked: list[int], view: View) -> tuple[Certainty, int | None]:
        pairs = {number: agreeing(self._nodes[number], view) for number in ranked}
        counts = {number: len(inliers) for number, inliers in pairs.items() if inliers is not None}
        if not counts:
            return Certainty.UNKNOWN, None
        best, *runners_up = rivals(counts, lambda a, b: abs(a - b) <= self._apart, COMPARABLE)
        return (Certainty.AMBIGUOUS if runners_up else Certainty.FOUND), best

    def _view(self, path: Path) -> View:
        return self._sift.extract(read_grey(path, self._camera)).view(self._camera)


def photograph_trials(verdicts: Sequence[JudgedAnswer]) -> list[LostDrive]:
    """A robot that asks at a photograph and, where that is no answer, at the next one.

    Photographs have no odometry. They are 1 to 3 m apart, so the next one is what lies within 2 m.
    """
    step = step_of(int(verdict.query) for verdict in verdicts)
    trials = []
    for first, second in zip(verdicts, [*verdicts[1:], None], strict=True):
        follows = second is not None and int(second.query) == int(first.query) + step
        asked = [first, second] if second is not None and follows else [first]
        answered = next((verdict for verdict in asked if verdict.certainty is Certainty.FOUND), None)
        right = None if answered is None else answered.right
        trials.append(LostDrive(first.expected, answered is not None, right))
    return trials


def _is_right(place: int, reference: Reference | None) -> bool:
    return reference is not None and reference.low <= place <= reference.high


def _number(image: Path) -> int:
    digits = re.findall(r"\d+", image.stem)
    if not digits:
        raise DeviceError(f"{image}: no number in its name")
    return int(digits[-1])


def _read_references(path: Path) -> dict[int, Reference | None]:
    references: dict[int, Reference | None] = {}
    try:
        with path.open(newline="") as file:
            for row in csv.DictReader(file):
                best, low, high = (row[name] for name in ("ref_best", "ref_lo", "ref_hi"))
                reference = Reference(int(best), int(low), int(high)) if best else None
                references[int(row["query"])] = reference
    except KeyError as missing:
        raise DeviceError(f"{path}: no column {missing.args[0]!r}") from None
    except (OSError, ValueError, TypeError, csv.Error) as error:
        raise DeviceError(f"{path}: {error}") from None
    if not references:
        raise DeviceError(f"{path}: no questions in it")
    return references
