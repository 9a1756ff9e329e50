"""A map with wrong geometry and true views changes no answers, and two similar rooms stay two."""

from collections import Counter

import pytest

from mapweave.hybridmap.constraint_subject import RetiredMap
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints
from mapweave.mapserver.answers import Answers
from mapweave.mapserver.map_history import MapHistory
from mapweave.mapserver.merging.merger import Merger
from synthetic.wrong_geometry import (
    ODD,
    SCENES,
    AnswerOutcome,
    FaultyFleet,
    OdometryFault,
    draw_fleet,
    judged,
    lost_views,
    merged_fleet,
)

SEED, QUESTIONS = 21, 16


def answer_outcomes(merger: Merger, fleet: FaultyFleet, scene: str) -> Counter[AnswerOutcome]:
    """Answers to robots that are lost in the house."""
    answers = Answers.of(merger, merger.merged(), merger.node)
    views = lost_views(fleet, SCENES[scene], QUESTIONS, SEED)
    return Counter(judged(answers, view, at, fleet.truth) for view, at in views)


@pytest.mark.slow
def test_a_map_with_wrong_geometry_is_named_and_changes_no_answer():
    fleet = draw_fleet(SEED, SCENES["room"], OdometryFault.SLIP, stops=2)
    alone = answer_outcomes(merged_fleet(fleet, frozenset({ODD})), fleet, "room")
    merger, history = merged_fleet(fleet), MapHistory()
    merged = merger.merged()
    history.follow(merged)
    assert history.newest.startswith(f"map {ODD} contradicts r0.1, r1.1 and r2.1")
    sound = [{node.map for node in part} for part in merged.components if ODD not in {n.map for n in part}]
    assert sound == [{MapId(f"r{k}", 1) for k in range(3)}]
    with_it = answer_outcomes(merger, fleet, "room")
    assert alone[AnswerOutcome.RIGHT] >= 0.7 * QUESTIONS
    assert (
        with_it[AnswerOutcome.RIGHT] >= 0.9 * alone[AnswerOutcome.RIGHT] and not with_it[AnswerOutcome.WRONG]
    )
    # Reported once, and the map counts again when a person has retired those that it contradicts.
    before = history.events
    history.follow(merged)
    assert history.events == before
    gone = [
        ManualConstraint(RetiredMap(item), True, "anna", 1, "moved")
        for item in (MapId("r0", 1), MapId("r1", 1))
    ]
    merger.constrain(ManualConstraints(gone))
    assert not merger.merged().wrong
    merger.constrain(ManualConstraints())
    assert merger.merged().wrong.keys() == {ODD}


@pytest.mark.slow
def test_a_correct_map_of_a_similar_room_is_not_wrong():
    """The fourth robot knows the twin of a room that the others know, and it is sound."""
    fleet = draw_fleet(SEED, SCENES["twins"], OdometryFault.NONE, stops=2)
    merger = merged_fleet(fleet)
    assert not merger.merged().wrong
    assert not answer_outcomes(merger, fleet, "twins")[AnswerOutcome.WRONG]
