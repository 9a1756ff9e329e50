"""Floor plans from Python: where they lie under the merged map, and their images."""

from __future__ import annotations

import hashlib

from mapweave.fleet_annotations import ANSWER
from mapweave.fleet_questions import FleetQuestions
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.floor_plan import PIECE, PlacedPlans, PlanImage, PlanPiece, PlanReceived
from mapweave.wire.messages import decode, encode


class FleetPlans(FleetQuestions):
    """The part of `mapweave.fleet.Fleet` that knows floor plans."""

    def plans(self) -> PlacedPlans:
        """Floor plans, and where they lie under the merged map.

        Raises:
            NotConnected: no map server answers.
        """
        return decode(self._question(self._keys.any_plans(), b"", ANSWER), PlacedPlans)

    def plan_image(self, sha256: str) -> bytes:
        """The PNG file of a plan, by the name of its image.

        Raises:
            Refused: the server does not have it.
            NotConnected: no map server answers.
        """
        return self._question(self._keys.any_plan_image(), sha256.encode(), ANSWER)

    def put_plan_image(self, png: bytes) -> PlanImage:
        """Send the image of a plan, a PNG file, before the annotation that names it.

        Raises:
            InvalidValue: it is no PNG file, or too large.
            NotConnected: no map server answers.
        """
        self._check_role()
        sha256, key = hashlib.sha256(png).hexdigest(), self._keys.any_put_plan_image()
        for offset in range(0, len(png), PIECE):
            piece = PlanPiece(sha256, len(png), offset, png[offset : offset + PIECE])
            received = decode(self._question(key, encode(piece), ANSWER), PlanReceived)
            if received.image is not None:
                return received.image
        raise InvalidValue("a plan is a PNG file")
