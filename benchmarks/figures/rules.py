"""The rules of docs/figures.md, and which results show what fails without them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Rule:
    """A rule that rejects links, answers or frames.

    Attributes:
        name: of the rule.
        file: where it stands.
        fails: templates of what fails without it, each with the name of the result; without a name, words.
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


def _trials(rule: str, scenario: str, source: str = "rules_trials") -> tuple[str, str]:
    """What comes of simulated trials without a rule, and with all."""
    found, whole = (
        f"{{trials/{scenario}/{way}/false_links}} of {{trials/{scenario}/{way}/links}}"
        for way in (rule, "all rules")
    )
    return f"{scenario}: false links {found} instead of {whole}", source


def _places(rule: str) -> tuple[str, str]:
    """Answers to lost robots without a rule, and with all."""
    kinds = (
        "{places/WAY/wrong/twins:.1%} of twin rooms, {places/WAY/wrong/nowhere:.1%} of unknown buildings, "
        "recall {places/WAY/recall_at_1:.1%}"
    )
    words = f"answered: {kinds.replace('WAY', rule)} instead of {kinds.replace('WAY', 'all rules')}"
    return words, "rules_places"


def _wrong_places(rule: str) -> tuple[str, str]:
    """Wrong answers to views of known places without a rule, and with all."""
    words = (
        f"known places that are answered with another one: {{places/{rule}/wrong_place:.2%}} instead "
        "of {places/all rules/wrong_place:.2%}"
    )
    return words, "rules_places"


def _lies(rule: str) -> tuple[str, str]:
    """The ways to lie that a rule contains, and those for which it names the robot."""
    words = (
        f"ways in which one robot of four lies, not contained: {{{rule}/not_contained}} instead of "
        f"{{all rules/not_contained}}; not named: {{{rule}/not_named}} instead of {{all rules/not_named}}"
    )
    return words, "rules_lies"


def _margins(rule: str, *ways: str) -> tuple[tuple[str, str], ...]:
    """What becomes of ways to lie that one rule contains, without it and with all."""
    figures = "{WAY/RULE/answers_changed} of 12 answers and {WAY/RULE/links_changed} links of the others"
    rows = []
    for way in ways:
        without, whole = (figures.replace("WAY", way).replace("RULE", one) for one in (rule, "all rules"))
        rows.append((f"{way}: changes {without} instead of {whole}", "lies_margins"))
    return tuple(rows)


def _loops(rule: str, way: str, figure: str, of: str = "") -> tuple[str, str]:
    """A figure of a robot's own loop closures without a rule, and with all, by the share of false ones.

    Args:
        rule: which.
        way: whole or resumed.
        figure: of the results, with its format.
        of: likewise, what it is a share of; empty if of nothing.
    """
    without, whole = (
        ", ".join(f"{{loops/{one}/{way}/{share}/{figure}}}" for share in (20, 50, 80))
        for one in (rule, "all rules")
    )
    every = ", ".join(f"{{loops/all rules/{way}/{share}/{of}}}" for share in (20, 50, 80))
    return f"{without} instead of {whole}{f' of {every}' if of else ''}", "rules_loops"


def _own_loops(rule: str, *figures: tuple[str, str, str, str]) -> tuple[tuple[str, str], ...]:
    """What comes of a robot's own loop closures, 20, 50 and 80 % of them false, without a rule.

    Args:
        rule: which.
        figures: words before a figure, and the last three arguments of `_loops`.
    """
    rows = [(words, _loops(rule, way, figure, of)) for words, way, figure, of in figures]
    return tuple((f"{words} {figure}", source) for words, (figure, source) in rows)


def _pairs(rule: str, kind: str) -> tuple[str, str]:
    """Links between nodes that are compared without a rule, and with all."""
    found, whole = (
        f"{{pairs/{way}/{kind}/wrong}} of {{pairs/{way}/{kind}/links}}" for way in (rule, "all rules")
    )
    return (
        f"{kind}, {{pairs/{rule}/{kind}/pairs}} pairs: wrong links {found} instead of {whole}",
        "rules_pairs",
    )


def _drives(rule: str, fault: str, *figures: str) -> tuple[str, str]:
    """What comes of drives with a fault without a rule, and with all."""
    words = {
        "wrong": "wrong edges {WAY/wrong_edges} of {WAY/edges}",
        "used": "images used {WAY/used_share:.0%}",
        "maps": "maps begun {WAY/maps}",
        "error": "error {WAY/error_m:.3f} m",
    }
    shown = ", ".join(words[figure] for figure in figures)
    without, whole = (shown.replace("WAY", f"drives/{fault}/{way}") for way in (rule, "all rules"))
    return f"{fault}: {without} instead of {whole}", "rules_drives"


OF_RECOGNITION = {
    "share of matches": ("poor camera",),
    "image cells": ("picture",),
    "landmarks in view": ("picture",),
    "depths": ("larger copy",),
    "mirrored pose": ("poor camera", "flat thing"),
}
"""What shows each rule of recognition."""
SHOWN_BY: dict[str, tuple[tuple[str, str], ...]] = {
    "maps that contradict themselves": (
        *_margins("maps that contradict themselves", "landmarks that occur twice", "a dozen small maps"),
        (
            "nine maps of four nodes make answers ambiguous: `tests/mapserver/test_lies.py"
            "::test_many_maps_of_one_robot_that_contradict_each_other_make_no_answer_ambiguous`",
            "",
        ),
    ),
    "views that contradict the way": (
        (
            "depths that are 30 % too long, and focal lengths that change, make 23 and 11 of 24 answers "
            "ambiguous (seeds 32001, 32002), and the robot is not named: "
            "`tests/mapserver/merging/test_own_views.py::test_a_map_whose_views_contradict_its_own_way_is_named`",
            "",
        ),
    ),
    "fragments": _margins("fragments", "small maps left behind"),
    "bent maps": _margins("bent maps", "steps a tenth too long"),
    "shuffled maps": _margins("shuffled maps", "one shuffled map"),
    "two sources of aliasing": (
        *_margins("two sources of aliasing", "false edges of its own"),
        ("edges to nowhere in a room: changes 11 of 12 answers and 212 links of the others (seed 884)", ""),
        (
            "one robot takes the weight of landmarks from links between two others: "
            "`tests/merge/outlier_rejection/test_distinctness.py"
            "::test_one_robot_alone_takes_no_landmarks_from_links_of_others`",
            "",
        ),
    ),
    "clocks that run backwards": (
        (
            "links that join the true map of a robot with such a clock: "
            "{a clock that runs backwards/clocks that run backwards/links_joining} instead of "
            "{a clock that runs backwards/all rules/links_joining}",
            "lies_margins",
        ),
    ),
    "optimisation in two stages": (
        (
            "an implausible map joins two others that nothing else joins: "
            "`tests/mapserver/test_lies.py::test_an_implausible_map_does_not_join_what_nothing_else_joins`",
            "",
        ),
    ),
    "torn maps": (
        (
            "altered copies behind a true drive are not found, where they are not known as copies: "
            "`tests/merge/test_torn_maps.py"
            "::test_altered_copies_behind_a_true_drive_are_found_out_by_their_arrangement`",
            "",
        ),
    ),
    "false places of one robot": (
        (
            "a robot with twelve wrong maps parts two others that three links join: "
            "`tests/merge/outlier_rejection/test_fleet_chance.py::test_wrong_maps_of_one_robot_part_no_others`",
            "",
        ),
    ),
}
"""What shows rules that no way of the run with all rules shows."""
AGAINST_LIES = {
    "copies": "mapserver/merging/copies.py",
    "unmeasurable edges": "hybridmap/edge_limits.py",
    "implausible maps": "mapserver/plausibility.py",
    "maps that contradict themselves": "mapserver/plausibility.py",
    "views that contradict the way": "merge/outlier_rejection/own_views.py",
    "fragments": "mapserver/plausibility.py",
    "unreliable robots": "mapserver/plausibility.py",
    "answers without implausible maps": "mapserver/active_nodes.py",
    "optimisation in two stages": "merge/pose_graph/staged_optimization.py",
    "clocks that run backwards": "merge/mutual_exclusion/trajectories.py",
    "bent maps": "merge/outlier_rejection/bent_maps.py",
    "shuffled maps": "merge/outlier_rejection/shuffled_maps.py",
    "torn maps": "merge/outlier_rejection/wrong_geometry.py",
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
        "one strong link joins",
        "merge/outlier_rejection/pairwise_consistency.py",
        (
            (
                "pairs of robots with one true link that are joined: {singles/one strong link/joined_alone} "
                "instead of {singles/all rules/joined_alone} of {singles/all rules/fleets}; its price, where "
                "a false link is as strong, joined falsely: "
                "{singles/one strong link/joined_falsely_contradicted} instead of "
                "{singles/all rules/joined_falsely_contradicted}",
                "rules_singles",
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
        (_trials("aliased landmarks", "warehouse", "rules_warehouse"),),
    ),
    Rule(
        "aliased regions",
        "mapserver/relocalization/aliased_regions.py",
        (_places("aliased regions"),),
    ),
    Rule(
        "lonely recognition",
        "mapserver/relocalization/place_hypotheses.py",
        (_wrong_places("lonely recognition"),),
    ),
    Rule(
        "rival places",
        "mapserver/relocalization/verdict.py",
        (_places("rivals"), _wrong_places("rivals")),
    ),
    Rule(
        "one weak node",
        "mapserver/relocalization/verdict.py",
        (_places("one weak node"), _wrong_places("one weak node")),
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
    *(Rule(name, file, SHOWN_BY.get(name) or (_lies(name),)) for name, file in AGAINST_LIES.items()),
    Rule(
        "own loop closures agree with the way",
        "merge/outlier_rejection/pairwise_consistency.py",
        _own_loops(
            "own way",
            (
                "one robot, 20, 50, 80 % of its own loop closures false: true ones kept",
                "whole",
                "true_loops",
                "of_true",
            ),
            ("resumed three times: false ones kept", "resumed", "false_loops", ""),
        ),
    ),
    Rule(
        "own loop closures agree with each other",
        "merge/outlier_rejection/pairwise_consistency.py",
        _own_loops(
            "own loops that agree",
            ("false ones kept", "whole", "false_loops", ""),
            ("error, m", "whole", "error_m_median:.2f", ""),
        ),
    ),
    Rule(
        "closing links",
        "merge/outlier_rejection/closing_links.py",
        _own_loops("closing links", ("resumed three times: false ones kept", "resumed", "false_loops", "")),
    ),
    Rule(
        "drives that contradict loop closures",
        "merge/outlier_rejection/loop_closures.py",
        _own_loops("drives against loops", ("true ones kept", "whole", "true_loops", "of_true")),
    ),
    *(
        Rule(name, "registration/recognition.py", tuple(_pairs(name, kind) for kind in kinds))
        for name, kinds in OF_RECOGNITION.items()
    ),
    Rule("certain links", "merge/pose_graph/verification.py", (_pairs("certain links", "poor camera"),)),
    Rule(
        "repeated images",
        "agent/mapping/image_acceptance.py",
        (_drives("repeated images", "images that come twice", "error"),),
    ),
    Rule(
        "strange images",
        "agent/mapping/kidnap_detection.py",
        (
            _drives("strange images", "other things", "wrong", "maps", "error"),
            _drives("strange images", "carried", "wrong"),
        ),
    ),
    Rule(
        "images that show nothing",
        "agent/mapping/kidnap_detection.py",
        (_drives("images that show nothing", "black images", "used", "maps", "error"),),
    ),
    Rule(
        "images in another light",
        "agent/mapping/image_acceptance.py",
        (_drives("images in another light", "lamps", "used", "maps"),),
    ),
    Rule(
        "odometry against images",
        "agent/mapping/odometry_consistency.py",
        (_drives("odometry against images", "spinning wheels", "wrong", "maps"),),
    ),
)
