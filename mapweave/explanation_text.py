"""Explanations as words for people, and as plain values for programs."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime

import numpy as np

from mapweave.hybridmap.explanation import (
    DOUBLES,
    Hop,
    MapsExplanation,
    NearMiss,
    PairExplanation,
    RouteExplanation,
    Standing,
    Witness,
)
from mapweave.hybridmap.manual_constraint import ManualConstraint
from mapweave.hybridmap.pose import Array, PoseGaussian

MOST_WITNESSES = 12
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


def pair_words(told: PairExplanation) -> list[str]:
    """The explanation of two nodes, line by line."""
    lines = [f"{told.a.id} and {told.b.id} {TITLES[told.standing]}: {told.reason}"]
    # What a robot followed on its way need not look alike at both ends.
    followed = told.standing is Standing.OWN and "inliers" not in told.evidence
    agree = "were followed on the way" if followed else "agree on one pose"
    lines.append(
        f"  landmarks     {len(told.a.landmarks)} and {len(told.b.landmarks)}; "
        f"{len(told.matches)} look alike, {len(told.shared)} {agree}{_doubles(told)}"
    )
    if told.a_from_b is not None:
        lines.append(f"  b seen from a {_pose(told.a_from_b)}")
        off = told.residuals_px[np.isfinite(told.residuals_px)]
        if len(off):
            rest = f"; {told.evidence['rms_px']:.1f} px" if "rms_px" in told.evidence else ""
            rest += " if depths may be off as far as they are uncertain" if rest else ""
            lines.append(f"  residuals     median {np.median(off):.1f} px, worst {off.max():.1f} px{rest}")
        lines += _evidence(told.evidence)
    if told.misfit is not None:
        misfit = told.misfit
        lines.append(f"  in the map    {_pose(misfit.merged_a_from_b)}")
        rest = "nothing else says how they stand" if misfit.alone else "others say it too"
        lines.append(f"  off by        {_vector(misfit.off)}, {_sigmas(misfit.strain2)}; {rest}")
    elif told.a_from_b is not None:
        lines.append("  in the map    nothing joins the two")
    if told.probability is not None:
        percent = _percent(told.probability)
        lines.append(f"  probability   {percent} that it is right, judged for itself by the rest of the map")
    if told.witnesses:
        count = sum(witness.agrees for witness in told.witnesses)
        lines.append(
            f"  other links   {count} of {len(told.witnesses)} between the same pieces of map agree:"
        )
    for witness in _telling(told.witnesses):
        word = "agrees" if witness.agrees else "contradicts"
        kept = "stands" if witness.kept else "refused"
        lines.append(f"    {witness.a} - {witness.b}: {word}, {_sigmas(witness.distance2)}, {kept}")
    if len(told.witnesses) > MOST_WITNESSES:
        lines.append(f"    and {len(told.witnesses) - MOST_WITNESSES} more; --json tells all")
    lines += [f"  {claim}" for claim in told.claims]
    lines += [f"  {_ruling(ruling)}" for ruling in told.rulings]
    return lines


def _evidence(evidence: Mapping[str, float]) -> list[str]:
    """All numbers, in lines between which none is torn from its name."""
    tied = "\N{NO-BREAK SPACE}"
    words = ", ".join(f"{name}{tied}{value:.3g}" for name, value in sorted(evidence.items()))
    lines = textwrap.wrap(words, WIDTH, initial_indent="  evidence      ", subsequent_indent=" " * 16)
    return [line.replace(tied, " ") for line in lines]


def _telling(witnesses: Sequence[Witness]) -> list[Witness]:
    """Those that are told, nearest first: of many that agree some leave their lines to those that do not."""
    ranked = sorted(witnesses, key=lambda w: w.distance2)
    against = [w for w in ranked if not w.agrees]
    agree = [w for w in ranked if w.agrees][: MOST_WITNESSES - min(len(against), MOST_WITNESSES // 2)]
    return [*agree, *against[: MOST_WITNESSES - len(agree)]]


def maps_words(told: MapsExplanation) -> list[str]:
    """The explanation of two maps, line by line."""
    lines = [told.reason]
    if not told.joined:
        lines.append(f"  {told.refused} links refused, {told.unverified} alike pairs without a common pose")
    if told.nearest:
        lines.append("  weakest links:" if told.joined else "  nearest to a link:")
    lines += [f"    {_near(near, told.reason)}" for near in told.nearest]
    lines += [f"  {_ruling(ruling)}" for ruling in told.rulings]
    return lines


def route_words(told: RouteExplanation) -> list[str]:
    """The explanation of a route, line by line."""
    way = "the way leads so" if told.found else "there is no way"
    lines = [f"{told.start} to {told.goal}: {way}: {told.reason}"]
    lines += [f"  {_hop(hop)}" for hop in told.hops]
    if told.gaps:
        lines.append("  not driven, and so not taken:" if told.found else "  what is missing:")
    lines += [f"    {_hop(hop)}" for hop in told.gaps[:MOST_WITNESSES]]
    if len(told.gaps) > MOST_WITNESSES:
        lines.append(f"    and {len(told.gaps) - MOST_WITNESSES} more; --json tells all")
    return lines + [f"  {line}" for line in (maps_words(told.apart) if told.apart else ())]


def _hop(hop: Hop) -> str:
    where = f"{hop.distance:5.2f} m, {math.degrees(hop.turn):+4.0f} deg, cost {hop.cost:5.2f}"
    return f"{hop.a!s:>9} - {hop.b!s:<9} {where}  {hop.kind}: {hop.words}"


def _pose(pose: PoseGaussian) -> str:
    sigma = np.sqrt(np.diag(pose.covariance))
    spread = f"{sigma[0]:.3f} m, {sigma[1]:.3f} m, {math.degrees(sigma[2]):.1f} deg"
    return f"{_vector(pose.mean.vector)} (sigma {spread})"


def _vector(vector: Array) -> str:
    return f"{vector[0]:+.3f} m ahead, {vector[1]:+.3f} m left, {math.degrees(vector[2]):+.1f} deg"


def _doubles(told: PairExplanation) -> str:
    count = int(told.evidence.get(DOUBLES, 0.0))
    return f", {count} of these are found at other places too" if count else ""


def _sigmas(chi2: float) -> str:
    return f"{math.sqrt(chi2):.1f} standard deviations"


def _percent(probability: float) -> str:
    if probability > 0.9999:
        return "over 99.99%"
    return f"{probability:.2%}" if probability > 0.0001 else f"{100.0 * probability:.2g}%"


def _near(near: NearMiss, known: str) -> str:
    """What is said above already of all of them is not said again of each."""
    lacks = "".join(f"; {words}" for words in near.lacks.split("; ") if words not in known)
    return f"{near.a} - {near.b}: {near.matches} look alike, {near.inliers} agree{lacks}"


def _ruling(ruling: ManualConstraint) -> str:
    when = datetime.fromtimestamp(ruling.stamp_ns // 1_000_000_000, UTC).strftime("%Y-%m-%d %H:%M UTC")
    word = "ruled that they shall not be linked" if ruling.apart else "ruled that they may be linked again"
    why = f': "{ruling.because}"' if ruling.because else ""
    if ruling.retires is not None:
        word = "ruled that it is retired" if ruling.apart else "ruled that it is in use again"
    ends = f"{ruling.ends[0]} and {ruling.ends[1]}" if ruling.retires is None else f"map {ruling.retires}"
    return f"{when} {ruling.who or 'somebody'} {word} ({ends}){why}"
