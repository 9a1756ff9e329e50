"""Manual constraints of a running fleet, from Python."""

from mapweave.constraint_methods import ConstraintMethods
from mapweave.fleet_annotations import ANSWER, FleetAnnotations
from mapweave.hybridmap.manual_constraint import ConstraintList, ConstraintRequest, ManualConstraint
from mapweave.wire.log_messages import decode_record
from mapweave.wire.messages import decode, encode
from mapweave.wire.senders import sent_by

CHECKING = 20.0
"""How long a server may take to check a manual constraint against a large map, s."""


class FleetConstraints(FleetAnnotations, ConstraintMethods):
    """The part of `mapweave.fleet.Fleet` by which people correct the merge."""

    def constraints(self) -> tuple[ManualConstraint, ...]:
        """What people have linked, unmerged, retired and taken back, in order; the first is number 1.

        Raises:
            NotConnected: no map server answers.
        """
        return decode(self._question(self._keys.any_constraints(), b"", ANSWER), ConstraintList).made

    def keep(self, request: ConstraintRequest) -> str:
        """Have every map server keep a manual constraint; where some refuse it, the words say why."""
        self._check_role()
        key = sent_by(self._keys.any_constrain(), self._sender)
        answers, refused = self._answers(key, encode(request), CHECKING)
        said = [str(decode_record(answer)["said"]) for answer in answers]
        return "\n".join([*said, *(f"another map server refused: {reason}" for reason in refused)])
