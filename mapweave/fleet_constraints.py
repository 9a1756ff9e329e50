"""Manual constraints of a running fleet, from Python."""

from __future__ import annotations

import time

from mapweave.connection import ANSWERED
from mapweave.constraint_methods import ConstraintMethods
from mapweave.fleet_annotations import FleetAnnotations
from mapweave.hybridmap.constraint_subject import Subject
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
        return decode(self._question(self._keys.any_constraints(), b"", ANSWERED), ConstraintList).made

    def constrain(self, about: Subject, holds: bool, because: str = "", *, check: bool = False) -> str:
        """Set a manual constraint of any kind, or take it back; see `link`."""
        self._check_role()
        constraint = ManualConstraint(about, holds, self._by, time.time_ns(), because)
        request = encode(ConstraintRequest(constraint, check))
        answer = self._question(sent_by(self._keys.any_constrain(), self._sender), request, CHECKING)
        return str(decode_record(answer)["said"])
