"""Explanations as people read them: nothing that counts is hidden, torn or cut off."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from mapweave.drawing.link_picture import draw_link
from mapweave.explanation_text import MOST_LINKS, WIDTH, pair_words
from mapweave.hybridmap.explanation import LinkAgreement, PairExplanation
from mapweave.hybridmap.ids import NodeId
from mapweave.merge.explanation.node_explanation import explain_nodes
from tests.mapserver.stub_services import two_maps


@pytest.fixture(scope="module")
def explanation() -> PairExplanation:
    merged = two_maps()
    return explain_nodes(merged, *next(link.pair for link in merged.links if not link.within))


@pytest.mark.parametrize(("agree", "against"), [(40, 3), (40, 40), (2, 40), (40, 0), (3, 4), (0, 0)])
def test_contradicting_links_are_listed_among_many_that_agree(
    explanation: PairExplanation, agree: int, against: int
):
    distances = [*(0.1 + 0.1 * k for k in range(agree)), *(100.0 + k for k in range(against))]
    nodes = (NodeId("r0", 1, 1), NodeId("r1", 1, 1))
    other_links = tuple(LinkAgreement(*nodes, d, d < 50.0, True) for d in distances)
    lines = pair_words(replace(explanation, other_links=other_links))
    counts = [sum(f": {word}, " in line for line in lines) for word in ("agrees", "contradicts")]
    assert sum(counts) == min(agree + against, MOST_LINKS)
    assert counts[1] >= min(against, MOST_LINKS // 2) and counts[0] >= min(agree, MOST_LINKS // 2)
    assert ("--json lists all" in "\n".join(lines)) == (agree + against > MOST_LINKS)
    nearest = [line for line in lines if "contradicts" in line][:1]
    assert not nearest or "10.0 standard deviations" in nearest[0]


def test_every_number_of_the_evidence_is_next_to_its_name(explanation: PairExplanation):
    lines = pair_words(explanation)
    begin = next(k for k, line in enumerate(lines) if line.startswith("  evidence "))
    rest = [line for line in lines[begin:] if line.startswith(("  evidence ", " " * 16))]
    assert len(rest) > 1 and max(map(len, rest)) <= WIDTH
    for name, value in explanation.evidence.items():
        assert any(f"{name} {value:.3g}" in line for line in rest)


@pytest.mark.parametrize("words", ["short", "quite long " * 60, r"no formula: $\frac{$"])
def test_the_picture_holds_all_words_of_its_title(explanation: PairExplanation, words: str, tmp_path):
    draw_link(replace(explanation, reason=words.strip()), tmp_path / "link.png")
    image = cv2.imread(str(tmp_path / "link.png"), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    assert (image[:4] > 250).all() and (image[-4:] > 250).all(), "nothing is cut off"
    # Rows with ink above the frames of the images, which are dark from side to side.
    frame = int(np.flatnonzero((image < 140).mean(axis=1) > 0.7)[0])
    ink = (image[:frame] < 128).any(axis=1)
    lines = int((ink[1:] & ~ink[:-1]).sum())
    wrapped = -(-len(words.strip()) // 110)
    assert lines >= 2 + wrapped, "the title, the reason, the nodes' names"
