"""The fleet whose map is asked, real places and made ones, and all questions to it."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import Any

import numpy as np
from rich.progress import Progress

from benchmarks.relocalize.distractors import AGENT, gather
from benchmarks.relocalize.exhaustive import AT_MOST, Exhaustive, asked_of, lost
from benchmarks.relocalize.peer import Vocabulary
from benchmarks.relocalize.places import TruePlace, joined, mapped, mapped_sites
from benchmarks.relocalize.queries import KINDS, Query, known, nowhere, twins
from benchmarks.relocalize.score import ScoredAnswer, ask, judged, share, spent
from mapweave.hybridmap.descriptor import decode
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Node
from mapweave.mapserver.relocalization.relocalizer import Relocalizer
from mapweave.mapserver.retrieval.place_index import PlaceIndex

DONORS = 800
"""Views behind the places that are not real."""


class Bench:
    """All that is asked of every size."""

    def __init__(self, seed: int, real: int, count: int, bar: Progress) -> None:
        """Take the pictures, or read them."""
        self.seed, self.bar = seed, bar
        sites = mapped_sites(seed)
        with self.task("places", real) as step:
            self.places = mapped(sites, real, seed, step)
        self.truth = {place.node.id: place for place in self.places}
        self.queries: list[Query] = []
        for kind in KINDS:
            with self.task(kind, count) as step:
                self.queries += known(kind, count, sites, self.places, seed, step)
        with self.task("twins", count) as step:
            self.queries += twins(count, sites, self.places, seed, step)
        with self.task("nowhere", count) as step:
            self.queries += nowhere(count, seed, step)
        with self.task("views of other buildings", DONORS) as step:
            self.distractors = gather(DONORS, self.places, seed, step)
        self.merged = joined(self.places, seed)
        self.making = np.zeros(2)
        """What was spent on making nodes, see benchmarks.relocalize.score.spent."""

    @cached_property
    def vocabulary(self) -> Vocabulary:
        """The vocabulary of the bag of words, learned from the real places."""
        return Vocabulary(np.concatenate([decode(p.node.landmarks.codes) for p in self.places]), self.seed)

    @contextmanager
    def task(self, name: str, total: int) -> Iterator[Callable[[], None]]:
        """A line of progress."""
        task = self.bar.add_task(name, total=total)
        yield lambda: self.bar.advance(task)
        self.bar.update(task, completed=total, total=total)

    def node(self, node_id: NodeId) -> Node | None:
        """A node of the fleet, whichever size it has."""
        if node_id.agent == AGENT:
            return self.made(node_id.number)
        place = self.truth.get(node_id)
        return None if place is None else place.node

    def place(self, number: int) -> TruePlace:
        """A place of the fleet by its number, those that are real first."""
        real = len(self.places)
        return self.places[number] if number < real else self.distractors.place(number - real)

    def made(self, number: int) -> Node:
        """A node that is not real."""
        began = spent()
        node = self.distractors.node(number)
        self.making = self.making + spent() - began
        return node

    def nodes(self, size: int) -> Iterator[Node]:
        """The fleet's nodes, at a size."""
        yield from (place.node for place in self.places[:size])
        yield from (self.made(k) for k in range(size - len(self.places)))

    def asked(self, name: str, relocalizer: Relocalizer) -> list[ScoredAnswer]:
        """All answers."""
        with self.task(name, len(self.queries)) as step:
            return ask(relocalizer.answer, self.queries, self.truth, step, lambda: self.making)

    def prepared(self, relocalizer: Relocalizer) -> float:
        """What the real nodes look like is found out, as a server does beside the questions; ms a node."""
        began, most = spent() - self.making, len(self.places)
        with self.task("what nodes look like", most) as step:
            for _ in range(most):
                relocalizer.prepare(1)
                step()
        return float(1e3 * (spent() - self.making - began)[1] / most)

    def ceiling(
        self, kinds: list[str], size: int, judge: Relocalizer, replies: list[ScoredAnswer]
    ) -> dict[str, Any]:
        """Recall of the exhaustive search, by kind, and what the index has lost of near views.

        Args:
            kinds: of views.
            size: nodes.
            judge: of what was recognised; it is that of the index.
            replies: by the index, to all queries.
        """
        values: dict[str, Any] = {"exhaustive_nodes": min(size, AT_MOST)}
        ours = {id(reply.query): reply for reply in replies}
        for kind in kinds:
            chosen = asked_of([query for query in self.queries if query.kind == kind], min(size, AT_MOST))
            exhaustive = Exhaustive(self.place, min(size, AT_MOST), judge)
            with self.task(f"{size} nodes: exhaustive, {kind}", min(size, AT_MOST) + len(chosen)) as step:
                answers = exhaustive.answers(chosen, step)
            theirs = [judged(q, answer, self.truth) for q, answer in zip(chosen, answers, strict=True)]
            values.setdefault("exhaustive", {})[kind] = share(theirs, lambda r: r.recalled)
            if kind == "near":
                values["recall_exhaustive"] = values["exhaustive"][kind]
                values |= lost([ours[id(query)] for query in chosen], theirs)
        return values

    def hardness(self) -> dict[str, dict[str, float]]:
        """How much the best wrong node looks like a view from nowhere, among real nodes and made ones."""
        count = len(self.places)
        made = [self.distractors.node(k) for k in range(count)]
        out = {}
        for name, nodes in (("real", [place.node for place in self.places]), ("made", made)):
            index = PlaceIndex()
            index.extend(nodes)
            views = [query.picture.view for query in self.queries if query.kind == "nowhere"]
            scores = [found[0][1] for view in views if (found := index.query(view, 1))]
            out[name] = {f"p{q}": round(float(np.percentile(scores, q)), 3) for q in (10, 50, 90, 99)}
        return out
