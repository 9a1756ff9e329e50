"""Annotations from Python: what people say about the map, floor plans among it, and nodes for words."""

import hashlib
from collections.abc import Iterable

from mapweave.annotation_methods import AnnotationMethods
from mapweave.fleet_questions import FleetQuestions
from mapweave.hybridmap.annotation import Annotation, AnnotationRequest, Annotations
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.floor_plan import PIECE, PlacedPlans, PlanImage, PlanPiece, PlanReceived
from mapweave.hybridmap.named_nodes import NodeWord, asked_of
from mapweave.hybridmap.query import ResolveAnswer, ResolveRequest
from mapweave.wire.log_messages import decode_record
from mapweave.wire.messages import decode, encode
from mapweave.wire.senders import sent_by

ANSWER = 10.0
"""A server that merges answers questions about its map late, s."""


class FleetAnnotations(FleetQuestions, AnnotationMethods):
    """The part of `mapweave.fleet.Fleet` by which people say what is not on the map."""

    def annotations(self) -> Annotations:
        """What people say about the map.

        Raises:
            NotConnected: no map server answers.
        """
        return decode(self._question(self._keys.any_annotations(), b"", ANSWER), Annotations)

    def resolve(self, request: ResolveRequest | NodeWord | Iterable[NodeWord]) -> ResolveAnswer:
        """Nodes for words: names of places, and positions in the merged map.

        Raises:
            InvalidValue: it is no text.
            Refused: a word is none, with the reason.
            NotConnected: no map server answers.
        """
        payload = encode(asked_of(request))
        return decode(self._question(self._keys.any_resolve(), payload, ANSWER), ResolveAnswer)

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

    def _check_writable(self, check: bool) -> None:
        self._check_role()

    def _say(self, annotation: Annotation, check: bool) -> str:
        key = sent_by(self._keys.any_annotate(), self._sender)
        return str(
            decode_record(self._question(key, encode(AnnotationRequest(annotation, check)), ANSWER))["said"]
        )
