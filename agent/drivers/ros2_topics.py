"""Topics of a robot: the newest message of each, decoded when it is wanted."""

import logging
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.drivers.camera import StampedImage
from mapweave.agent.drivers.clock import RemoteClock, of_monotonic_ns
from mapweave.agent.drivers.wheeled import STALE
from mapweave.agent.ros_messages.images import GreyImages
from mapweave.agent.ros_messages.values import TF_TYPE, FixedTransforms, Mount, stamp_of
from mapweave.hybridmap.errors import DeviceError, MapweaveError
from mapweave.wire.ros2.messages import decode
from mapweave.wire.ros2.node import Arrival, Ros2Node

log = logging.getLogger(__name__)


class Received(NamedTuple):
    """A decoded message.

    Attributes:
        message: by its ROS names.
        kind: its type.
        stamp_ns: when it was measured, as `clock.now_ns`.
    """

    message: Any
    kind: str
    stamp_ns: int


class NewestMessage:
    """The newest message of a topic."""

    def __init__(self, node: Ros2Node, name: str, kinds: Sequence[str], clock: RemoteClock | None) -> None:
        """Subscribe.

        Args:
            node: of the driver.
            name: as in the settings.
            kinds: the types that its messages may have.
            clock: of the robot's computer; None for what is published once and stays true.
        """
        self.name = node.link.topic(name)
        self._node, self._kinds, self._clock = node, tuple(kinds), clock
        self._changed = threading.Condition()
        self._arrival: Arrival | None = None
        self._count = 0
        self._received: tuple[Arrival, Any, int] | None = None
        self._subscriber = node.subscribe(self.name, kinds, self._take, latched=clock is None)

    def wait(self, count: int, patience: float) -> int:
        """Wait for more than `count` messages in all; returns how many there are."""
        with self._changed:
            self._changed.wait_for(lambda: self._count > count, max(patience, 0.0))
            return self._count

    def newest(self) -> Received | None:
        """The newest message; None before the first one.

        Raises:
            DeviceError: it is damaged.
        """
        with self._changed:
            arrival, known = self._arrival, self._received
        if arrival is None:
            return None
        if known is None or known[0] is not arrival:
            try:
                message = decode(arrival.kind, arrival.data)
            except MapweaveError as error:
                raise DeviceError(f"{self.name}: {error}") from None
            stamp_ns = of_monotonic_ns(arrival.arrived_ns)
            if self._clock is not None:
                stamp_ns = self._clock.local(stamp_of(message) or arrival.published_ns, stamp_ns)
            known = self._received = arrival, message, stamp_ns
        return Received(known[1], arrival.kind, known[2])

    @property
    def silent(self) -> bool:
        """Whether no message has come in the last moments."""
        arrival = self._arrival
        if arrival is None or self._clock is None:
            return arrival is None
        return time.monotonic_ns() - arrival.arrived_ns > STALE * 1e9

    def first(self, what: str, patience: float) -> Received:
        """Wait for a message if it is silent, and return the newest.

        Args:
            what: it is, for the error.
            patience: s.

        Raises:
            DeviceError: none comes, or it is damaged.
        """
        with self._changed:
            self._changed.wait_for(lambda: not self.silent, max(patience, 0.0))
        received = self.newest()
        if received is None or self.silent:
            raise DeviceError(self._missing(what))
        return received

    def _missing(self, what: str) -> str:
        endpoint = self._node.link.endpoint
        if not self._node.connected():
            return f"no router at {endpoint}: start `ros2 run rmw_zenoh_cpp rmw_zenohd`, or the bridge"
        if self._subscriber.refused:
            return f"{self.name} has {self._subscriber.refused}; {what} are {' or '.join(self._kinds)}"
        others = self._node.publishers(self._kinds)
        there = f"there are {', '.join(others)}" if others else "no topic has any"
        return f"no {what} on {self.name}; {there}"

    def _take(self, arrival: Arrival) -> None:
        with self._changed:
            self._arrival = arrival
            self._count += 1
            self._changed.notify_all()


class Mounts:
    """Where sensors are on the robot, by /tf_static."""

    def __init__(self, node: Ros2Node) -> None:
        """Subscribe."""
        self.name = node.link.topic("tf_static")
        self._changed = threading.Condition()
        self._transforms = FixedTransforms()
        node.subscribe(self.name, (TF_TYPE,), self._take, latched=True)

    def camera(self, frame: str, patience: float) -> Mount | None:
        """The mount of a camera whose optical frame is given; None if it is unknown."""
        return self._wait(lambda: self._transforms.camera(frame), patience)

    def sensor(self, frame: str, patience: float) -> Mount | None:
        """The mount of a sensor that looks along the x axis of a frame; None if it is unknown."""
        return self._wait(lambda: self._transforms.sensor(frame), patience)

    def _wait(self, find: Callable[[], Mount | None], patience: float) -> Mount | None:
        with self._changed:
            self._changed.wait_for(lambda: find() is not None, max(patience, 0.0))
            return find()

    def _take(self, arrival: Arrival) -> None:
        message = decode(arrival.kind, arrival.data)
        with self._changed:
            self._transforms.add(message)
            self._changed.notify_all()


class Ros2Camera:
    """Images of a topic."""

    def __init__(self, topic: NewestMessage) -> None:
        """Take the topic; the node stays another's."""
        self._topic = topic
        self._images = GreyImages(topic.name)
        self._seen = 0
        self._complaint = ""

    def newer(self, stamp_ns: int, patience: float) -> StampedImage | None:
        """Wait for an image newer than a stamp; see FrameSource."""
        end = time.monotonic() + patience
        while True:
            count = self._topic.wait(self._seen, end - time.monotonic())
            if count == self._seen:
                return None
            self._seen = count
            try:
                received = self._topic.newest()
                assert received is not None
                image: NDArray[np.uint8] = self._images.read(received.message)
            except MapweaveError as error:
                if str(error) != self._complaint:
                    self._complaint = str(error)
                    log.warning("%s: %s", self._topic.name, error)
                continue
            if received.stamp_ns > stamp_ns:
                return StampedImage(received.stamp_ns, image)

    def close(self) -> None:
        """Nothing is to be released."""
