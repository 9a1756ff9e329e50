"""Floor plans of a running server: their images, and where each lies under the newest merged map."""

import hashlib
import logging
import threading
from collections.abc import Callable, Mapping
from pathlib import Path

from mapweave.hybridmap.annotation import Annotation, Annotations
from mapweave.hybridmap.errors import InvalidFile, InvalidMessage, InvalidValue
from mapweave.hybridmap.floor_plan import FloorPlan, PlacedPlans, PlanImage, PlanPiece, PlanReceived
from mapweave.mapserver.floor_plans import placed_plans
from mapweave.mapserver.log.store import Store
from mapweave.mapserver.plan_images import PlanImages
from mapweave.mapserver.services import guarded
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.storage.plan_image import plan_file
from mapweave.wire.bus import Bus, BusClient
from mapweave.wire.keys import Keys
from mapweave.wire.messages import decode, encode

log = logging.getLogger(__name__)

MOST_AT_ONCE = 4
"""Images on their way; one more takes the place of the oldest."""


class PlanService(BusClient):
    """BusClient on a bus until closed. Thread-safe."""

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        name: str,
        merged: Callable[[], MergedMap],
        annotations: Callable[[], Annotations],
        store: Path,
        beside: Mapping[str, bytes],
        shared: Store | None = None,
    ) -> None:
        """Begin to answer.

        Args:
            bus: the connection; stays the caller's.
            keys: of the fleet.
            name: of the server in the fleet.
            merged: the newest merged map. May wait for it.
            annotations: the record, in which the plans are.
            store: path of the server's store, beside which the images are.
            beside: images of the map that the server was given at its start.
            shared: the store of several servers, which has the images, too.
        """
        self._merged, self._annotations = merged, annotations
        used = {entry.body.image.sha256 for entry in annotations().made if isinstance(entry.body, FloorPlan)}
        self.images = PlanImages(store, used, beside, shared)
        self._lock = threading.Lock()
        self._incoming: dict[str, bytearray] = {}
        self._placed: tuple[MergedMap, Annotations, PlacedPlans] | None = None
        self._closing = [
            bus.serve(keys.plans(name), guarded(lambda _: encode(self.plans()))),
            bus.serve(keys.plan_image(name), guarded(lambda payload: self.images.get(_sha256(payload)))),
            bus.serve(
                keys.put_plan_image(name),
                guarded(lambda payload: encode(self.receive(decode(payload, PlanPiece)))),
            ),
        ]

    def plans(self) -> PlacedPlans:
        """All plans, under the newest merged map; worked out once for each."""
        merged, annotations = self._merged(), self._annotations()
        with self._lock:
            if self._placed is None or self._placed[0] is not merged or self._placed[1] != annotations:
                self._placed = merged, annotations, placed_plans(annotations, merged)
            return self._placed[2]

    def image(self, name: str) -> bytes:
        """The PNG file of a plan.

        Raises:
            InvalidValue: there is none of this name.
            InvalidFile: its image is lost.
        """
        return self.images.get(self.plans().plan(name).plan.image.sha256)

    def receive(self, piece: PlanPiece) -> PlanReceived:
        """Take a piece of an image; the last one puts it on the disk.

        Raises:
            InvalidValue: pieces are missing, or the whole is no PNG file.
        """
        with self._lock:
            if piece.offset == 0:
                self._incoming.pop(piece.sha256, None)
                if len(self._incoming) >= MOST_AT_ONCE:
                    del self._incoming[next(iter(self._incoming))]
                self._incoming[piece.sha256] = bytearray()
            data = self._incoming.get(piece.sha256)
            if data is None or len(data) != piece.offset or piece.offset + len(piece.data) > piece.size:
                raise InvalidValue("a piece of the image is missing: send it again from its beginning")
            data += piece.data
            if len(data) < piece.size:
                return PlanReceived(len(data))
            del self._incoming[piece.sha256]
        if hashlib.sha256(data).hexdigest() != piece.sha256:
            raise InvalidValue("the image was damaged on its way: send it again")
        return PlanReceived(piece.size, self.images.put(bytes(data)))

    def put(self, data: bytes, negate: bool = False) -> PlanImage:
        """Keep an image of any kind as a PNG file, also as a negative; raises InvalidValue if it is none."""
        return self.images.put(plan_file(data, negate=negate).png)

    def check(self, annotation: Annotation) -> None:
        """Refuse a plan without its image (InvalidValue)."""
        plan = annotation.body
        if isinstance(plan, FloorPlan) and not annotation.removed and plan.image.sha256 not in self.images:
            raise InvalidValue("the image of this plan is not on the server: send it first")

    def files(self) -> dict[str, bytes]:
        """The images of the plans in force, for a map file; those that are lost or damaged are left out."""
        files: dict[str, bytes] = {}
        for _, plan in self._annotations().in_force(FloorPlan):
            try:
                files[plan.image.sha256] = self.images.get(plan.image.sha256)
            except InvalidFile as error:
                log.warning("a map file is made without an image: %s", error)
        return files


def _sha256(payload: bytes) -> str:
    try:
        return payload.decode("ascii")
    except UnicodeDecodeError:
        raise InvalidMessage("no name of an image") from None
