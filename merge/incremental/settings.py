"""When and how a large merge is made in steps."""

from __future__ import annotations

from dataclasses import dataclass, field

from merge.incremental.relaxing import RelaxSettings


@dataclass(frozen=True)
class StepSettings:
    """When and how a merge is made in steps.

    Attributes:
        anew_up_to: islands of as many nodes are merged anew whenever they change, so that the outcome is
            exactly that of one merge.
        past_share: if they have no greater share of nodes of another day for which others stand.
        whole_share: everything is decided again when so many measurements have come or gone since it was last
            done, as a share of all.
        whole_up_to: islands of more nodes are decided again beside the steps, for it would hold these up (see
            merge.incremental.again); in a step only once, when nothing is known of them yet.
        optimise_share: the same for optimising everything: what is left of strain after each step adds up.
        relax: how far a change is followed.
    """

    anew_up_to: int = 600
    past_share: float = 0.3
    whole_share: float = 0.1
    whole_up_to: int = 3000
    optimise_share: float = 0.01
    relax: RelaxSettings = field(default_factory=RelaxSettings)
