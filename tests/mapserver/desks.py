"""A desk that answers as a test says, and a picture to ask it about."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future

import cv2
import numpy as np

from hybridmap.errors import Busy
from hybridmap.node import NodeId
from hybridmap.pose import Pose2, PoseGaussian
from hybridmap.query import Certainty, RelocalizeAnswer, View, Whereabouts

HERE = PoseGaussian.from_sigmas(Pose2(0.5, -0.25, 0.1), 0.02, 0.01)
ANSWER = RelocalizeAnswer(
    Certainty.FOUND,
    (Whereabouts(NodeId("r0", 1, 7), HERE, None, -1, 31, 0.99),),
    "31 landmarks of r0.1.7 agree",
)

PLACE = RelocalizeAnswer(
    Certainty.PLACE,
    (Whereabouts(NodeId("r0", 1, 7), HERE, None, -1, 31, 0.9, distance_known=False),),
    "31 landmarks of r0.1.7, which has no depths, agree",
)


class Desk:
    """Answers everything alike and remembers what was asked, or does what the test says."""

    def __init__(self) -> None:
        self.views: list[View] = []
        self.refusal: Exception | None = None
        self.answer = ANSWER

    def locate(self, look: Callable[[], View], ticket: int) -> Future[RelocalizeAnswer]:
        done: Future[RelocalizeAnswer] = Future()
        if isinstance(self.refusal, Busy):
            raise self.refusal
        try:
            self.views.append(look())
            if self.refusal is not None:
                raise self.refusal
            done.set_result(self.answer)
        except Exception as error:  # noqa: BLE001 - as a worker would
            done.set_exception(error)
        return done


def picture(width: int = 160, height: int = 120, kind: str = ".png") -> bytes:
    """Something with features in it."""
    noise = np.random.default_rng(1).integers(0, 255, (height // 8, width // 8)).astype(np.uint8)
    image = cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)
    return bytes(cv2.imencode(kind, image)[1].tobytes())
