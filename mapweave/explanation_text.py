"""Explanations as words for people, and as plain values for programs."""

import math
import textwrap
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime

import numpy as np

from mapweave.hybridmap.constraint_subject import Apart, Linked
from mapweave.hybridmap.counted import counted
from mapweave.hybridmap.explanation import (
    ALIASED,
    Hop,
    LinkAgreement,
    MapsExplanation,
    NearMiss,
    PairExplanation,
    RouteExplanation,
    Standing,
)
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraint, retired_words
from mapweave.hybridmap.pose import Array, PoseGaussian
from mapweave.merge.explanation.twin_maps import TWINS

MOST_LINKS = 12
"""Lines of other links; `--json` has all."""
WIDTH = 110
"""Columns of a line of numbers."""
TITLES = {
    Standing.LINKED: "are linked",
    Standing.OWN: "are joined",
    Standing.REFUSED: "are not linked",
    Standing.UNDONE: "are not linked",
    Standing.UNCOMPARED: "were not compared by the merge",
}


def with_node(word: str, node: NodeId) -> str:
    """A node as a person has written it, and its id where that is another word."""
    return word if word == str(node) else f"{word} ({node})"


def pair_words(explanation: PairExplanation, written: Mapping[str, str] | None = None) -> list[str]:
    """The explanation of two nodes, line by line.

    Args:
        explanation: of the two nodes.
        written: how a person has written each, by its id (default: as ids).
    """
    a, b = (
        with_node((written or {}).get(str(node), str(node)), node)
        for node in (explanation.a.id, explanation.b.id)
    )
    lines = [f"{a} and {b} {TITLES[explanation.standing]}: {explanation.reason}"]
    # Landmarks that a robot tracked on its way need not match at both ends.
    followed = explanation.standing is Standing.OWN and "inliers" not in explanation.evidence
    agree = "were followed on the way" if followed else "agree on one pose"
    lines.append(
        f"  landmarks     {len(explanation.a.landmarks)} and {len(explanation.b.landmarks)}; "
        f"{len(explanation.matches)} match, {len(explanation.shared)} {agree}{_aliased(explanation)}"
    )
    if explanation.a_from_b is not None:
        lines.append(f"  b seen from a {_pose(explanation.a_from_b)}")
        off = explanation.residuals_px[np.isfinite(explanation.residuals_px)]
        if len(off):
            rest = f"; {explanation.evidence['rms_px']:.1f} px" if "rms_px" in explanation.evidence else ""
            rest += " with depths adjusted within their uncertainty" if rest else ""
            lines.append(f"  residuals     median {np.median(off):.1f} px, worst {off.max():.1f} px{rest}")
        lines += _evidence(explanation.evidence)
    if explanation.misfit is not None:
        misfit = explanation.misfit
        lines.append(f"  in the map    {_pose(misfit.merged_a_from_b)}")
        rest = "nothing else connects them" if misfit.alone else "others say it too"
        lines.append(f"  off by        {_vector(misfit.off)}, {_sigmas(misfit.strain2)}; {rest}")
    elif explanation.a_from_b is not None:
        lines.append("  in the map    nothing joins the two")
    if explanation.probability is not None:
        percent = _percent(explanation.probability)
        lines.append(f"  probability   {percent} that it is right, judged for itself by the rest of the map")
    if explanation.other_links:
        count = sum(link.agrees for link in explanation.other_links)
        lines.append(
            f"  other links   {count} of {len(explanation.other_links)} between the same pieces of map agree:"
        )
    for link in _selection(explanation.other_links):
        word = "agrees" if link.agrees else "contradicts"
        kept = "stands" if link.kept else "refused"
        lines.append(f"    {link.a} - {link.b}: {word}, {_sigmas(link.distance2)}, {kept}")
    if len(explanation.other_links) > MOST_LINKS:
        lines.append(f"    and {len(explanation.other_links) - MOST_LINKS} more; --json lists all")
    lines += [f"  {claim}" for claim in explanation.claims]
    lines += _record(explanation.constraints, explanation.reason)
    return lines


def _evidence(evidence: Mapping[str, float]) -> list[str]:
    """All numbers, in lines between which none is torn from its name."""
    tied = "\N{NO-BREAK SPACE}"
    words = ", ".join(f"{name}{tied}{value:.3g}" for name, value in sorted(evidence.items()))
    lines = textwrap.wrap(words, WIDTH, initial_indent="  evidence      ", subsequent_indent=" " * 16)
    return [line.replace(tied, " ") for line in lines]


def _selection(links: Sequence[LinkAgreement]) -> list[LinkAgreement]:
    """The links that are listed, nearest first: both agreeing and contradicting ones get lines."""
    ranked = sorted(links, key=lambda w: w.distance2)
    against = [w for w in ranked if not w.agrees]
    agree = [w for w in ranked if w.agrees][: MOST_LINKS - min(len(against), MOST_LINKS // 2)]
    return [*agree, *against[: MOST_LINKS - len(agree)]]


def maps_words(explanation: MapsExplanation) -> list[str]:
    """The explanation of two maps, line by line."""
    lines = [explanation.reason]
    if explanation.refused or explanation.unverified:
        lines.append(
            f"  {counted(explanation.refused, 'link')} refused, "
            f"{counted(explanation.unverified, 'candidate pair')} without a common pose"
        )
    if explanation.nearest:
        lines.append("  weakest links:" if explanation.joined else "  nearest to a link:")
    lines += [f"    {_near(near_miss, explanation.reason)}" for near_miss in explanation.nearest]
    if TWINS in explanation.reason:
        # The reason is the same on the page, where a command of the shell means nothing.
        lines.append(f"  `mapweave map retire {explanation.first} --because TEXT`, or {explanation.second}")
    lines += _record(explanation.constraints, explanation.reason)
    return lines


def route_words(
    explanation: RouteExplanation, places: Sequence[str] | None = None, title: str = ""
) -> list[str]:
    """The explanation of a route, line by line.

    Args:
        explanation: of the route.
        places: where its start and the end of each of its hops are, in words.
        title: from where to where (default: from node to node).
    """
    way = "the route is" if explanation.found else "there is no way"
    lines = [f"{title or f'{explanation.start} to {explanation.goal}'}: {way}: {explanation.reason}"]
    steps = [f"  {_hop(hop)}" for hop in explanation.hops]
    if places is not None:
        lines.append(f"  {explanation.start} {places[0]}")
        steps = [f"{step}, {place}" for step, place in zip(steps, places[1:], strict=True)]
    lines += steps
    if explanation.gaps:
        lines.append("  not driven, and so not taken:" if explanation.found else "  what is missing:")
    lines += [f"    {_hop(hop)}" for hop in explanation.gaps[:MOST_LINKS]]
    if len(explanation.gaps) > MOST_LINKS:
        lines.append(f"    and {len(explanation.gaps) - MOST_LINKS} more; --json lists all")
    return lines + [f"  {line}" for line in (maps_words(explanation.apart) if explanation.apart else ())]


def _hop(hop: Hop) -> str:
    where = f"{hop.distance:5.2f} m, {math.degrees(hop.turn):+4.0f} deg, cost {hop.cost:5.2f}"
    return f"{hop.a!s:>9} - {hop.b!s:<9} {where}  {hop.kind}: {hop.words}"


def _pose(pose: PoseGaussian) -> str:
    sigma = np.sqrt(np.diag(pose.covariance))
    spread = f"{sigma[0]:.3f} m, {sigma[1]:.3f} m, {math.degrees(sigma[2]):.1f} deg"
    return f"{_vector(pose.mean.vector)} (sigma {spread})"


def _vector(vector: Array) -> str:
    return f"{vector[0]:+.3f} m ahead, {vector[1]:+.3f} m left, {math.degrees(vector[2]):+.1f} deg"


def _aliased(explanation: PairExplanation) -> str:
    count = int(explanation.evidence.get(ALIASED, 0.0))
    return f", {count} of these are found at other places too" if count else ""


def _sigmas(chi2: float) -> str:
    return f"{math.sqrt(chi2):.1f} standard deviations"


def _percent(probability: float) -> str:
    if probability > 0.9999:
        return "over 99.99%"
    return f"{probability:.2%}" if probability > 0.0001 else f"{100.0 * probability:.2g}%"


def _near(near_miss: NearMiss, reason: str) -> str:
    """The common reason is not repeated for each."""
    lacks = "".join(f"; {words}" for words in near_miss.lacks.split("; ") if words not in reason)
    return f"{near_miss.a} - {near_miss.b}: {near_miss.matches} match, {near_miss.inliers} agree{lacks}"


def _record(constraints: Sequence[ManualConstraint], reason: str) -> list[str]:
    """A line for each constraint, but for what is retired if the reason says so already."""
    return [
        f"  {_constraint(one)}" for one in constraints if not one.holds or retired_words(one) not in reason
    ]


def _constraint(constraint: ManualConstraint) -> str:
    when = datetime.fromtimestamp(constraint.stamp_ns // 1_000_000_000, UTC).strftime("%Y-%m-%d %H:%M UTC")
    match constraint.about, constraint.holds:
        case Apart(), holds:
            word = "they shall not be linked" if holds else "they may be linked again"
        case Linked(), holds:
            word = "they see one place" if holds else "they are no longer linked by hand"
        case _, holds:
            word = "it is retired" if holds else "it is in use again"
    why = f': "{constraint.because}"' if constraint.because else ""
    return f"{when} {constraint.who or 'a person'} decided that {word} ({constraint.about}){why}"
