"""The rules of docs/figures.md, and which results show what fails without them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Rule:
    """A rule that rejects links, answers or frames.

    Attributes:
        name: of the rule.
        file: where it stands.
        fails: templates of what fails without it, each with the name of the result.
    """

    name: str
    file: str
    fails: tuple[tuple[str, str], ...]


def _fleets(rule: str) -> tuple[str, str]:
    """What comes of fleets without a rule, and with all."""
    good, falsely, good_all, falsely_all = (
        ", ".join(f"{{fleets/{way}/{share}/{figure}}}" for share in (50, 80, 90))
        for way in (rule, "all rules")
        for figure in ("good", "joined_falsely")
    )
    words = (
        f"fleets as good as with the true links known, with 50, 80, 90 % false ones: {good} instead of "
        f"{good_all}; joined falsely: {falsely} instead of {falsely_all}"
    )
    return words, "rules_fleets"


def _trials(rule: str, scenario: str) -> tuple[str, str]:
    """What comes of simulated trials without a rule, and with all."""
    found, whole = (
        f"{{trials/{scenario}/{way}/false_links}} of {{trials/{scenario}/{way}/links}}"
        for way in (rule, "all rules")
    )
    return f"{scenario}: false links {found} instead of {whole}", "rules_trials"


def _places(rule: str) -> tuple[str, str]:
    """Answers to lost robots without a rule, and with all."""
    kinds = (
        "{places/WAY/wrong/twins:.1%} of twin rooms, {places/WAY/wrong/nowhere:.1%} of unknown buildings, "
        "recall {places/WAY/recall_at_1:.1%}"
    )
    words = f"answered: {kinds.replace('WAY', rule)} instead of {kinds.replace('WAY', 'all rules')}"
    return words, "rules_places"


def _lies(rule: str) -> tuple[str, str]:
    """The ways to lie that a rule contains, and those for which it names the robot."""
    words = (
        f"ways in which one robot of four lies, not contained: {{{rule}/not_contained}} instead of "
        f"{{all rules/not_contained}}; not named: {{{rule}/not_named}} instead of {{all rules/not_named}}"
    )
    return words, "rules_lies"


AGAINST_LIES = {
    "copies": "mapserver/merging/copies.py",
    "refused changes": "mapserver/merging/implausible_maps.py",
    "unmeasurable edges": "hybridmap/edge_limits.py",
    "implausible maps": "mapserver/plausibility.py",
    "maps that contradict themselves": "mapserver/plausibility.py",
    "fragments": "mapserver/plausibility.py",
    "unreliable robots": "mapserver/plausibility.py",
    "answers without implausible maps": "mapserver/active_nodes.py",
    "optimisation in two stages": "merge/pose_graph/staged_optimization.py",
    "clocks that run backwards": "merge/mutual_exclusion/trajectories.py",
    "bent maps": "merge/outlier_rejection/bent_maps.py",
    "shuffled maps": "merge/outlier_rejection/shuffled_maps.py",
    "torn maps": "merge/torn_maps.py",
    "two sources of aliasing": "merge/outlier_rejection/distinctness.py",
    "false places of one robot": "merge/outlier_rejection/fleet_chance.py",
}
"""File by rule."""

RULES = (
    Rule(
        "independent support",
        "merge/outlier_rejection/independent_support.py",
        (_fleets("independent support"),),
    ),
    Rule(
        "support beyond chance",
        "merge/outlier_rejection/independent_support.py",
        (_fleets("chance support"),),
    ),
    Rule(
        "dominance",
        "merge/outlier_rejection/pairwise_consistency.py",
        (
            (
                "pairs of robots with as many links to a similar place, joined falsely: "
                "{twins/dominance/joined_falsely} instead of {twins/all rules/joined_falsely} of "
                "{twins/dominance/fleets}",
                "rules_twins",
            ),
        ),
    ),
    Rule(
        "refused links heard again",
        "merge/outlier_rejection/agglomerative_joining.py",
        (
            (
                "share of true links kept at 50, 80, 90 % false links: "
                + ", ".join(
                    f"{{fleets/refused links heard again/{share}/recall:.3f}}" for share in (50, 80, 90)
                )
                + " instead of "
                + ", ".join(f"{{fleets/all rules/{share}/recall:.3f}}" for share in (50, 80, 90)),
                "rules_fleets",
            ),
        ),
    ),
    Rule(
        "mutual exclusion",
        "merge/mutual_exclusion/",
        (_trials("mutual exclusion", "twin-corridor"),),
    ),
    Rule(
        "aliased landmarks",
        "merge/outlier_rejection/distinctness.py",
        (
            (
                "warehouse: {trials/warehouse/aliased landmarks/links} links instead of "
                "{trials/warehouse/all rules/links}, maps in {trials/warehouse/aliased landmarks/components} "
                "pieces instead of {trials/warehouse/all rules/components}",
                "rules_trials",
            ),
        ),
    ),
    Rule(
        "aliased regions",
        "mapserver/relocalization/aliased_regions.py",
        (_places("aliased regions"),),
    ),
    Rule(
        "lonely recognition",
        "mapserver/relocalization/place_hypotheses.py",
        (
            (
                "views of known places that are answered with another one: "
                "{places/lonely recognition/wrong_place:.2%} instead of {places/all rules/wrong_place:.2%}",
                "rules_places",
            ),
        ),
    ),
    Rule(
        "wrong geometry",
        "merge/outlier_rejection/wrong_geometry.py",
        (
            (
                "right answers to lost robots: {rule_off/right} instead of {with_the_map/right}; fleets "
                "whose sound maps are in pieces: {rule_off/in_pieces} instead of {with_the_map/in_pieces} of "
                "{with_the_map/fleets}",
                "wrong_geometry",
            ),
            _lies("wrong geometry"),
        ),
    ),
    *(Rule(name, file, (_lies(name),)) for name, file in AGAINST_LIES.items()),
)
