"""A bag of visual words: the independent retrieval that the place index is compared with.

A vocabulary tree (Nister and Stewenius, CVPR 2006) over the same compact descriptors, tf-idf weights, cosines
(Sivic and Zisserman, ICCV 2003); plain numpy and scipy. What it retrieves is verified by the same geometry.
"""

from collections.abc import Callable, Iterable
from itertools import islice
from typing import Any

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2

from mapweave.hybridmap.descriptor import decode
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.query import View
from mapweave.mapserver.retrieval.ranking import Ranked

BRANCHES, LEVELS = 24, 3
"""13 824 words."""
TRAINED_ON = 60_000
"""Descriptors."""
AT_ONCE = 1024
"""Nodes whose words are counted at once."""


class Vocabulary:
    """A tree of means, level by level."""

    def __init__(self, vectors: NDArray[np.float32], seed: int) -> None:
        """Learn it.

        Args:
            vectors: (N, 32) decoded descriptors.
            seed: of the means' starts.
        """
        rng = np.random.default_rng([seed, 0xB0])
        sample = vectors[rng.permutation(len(vectors))[:TRAINED_ON]].astype(np.float64)
        self._levels: list[NDArray[np.float64]] = []
        word = np.zeros(len(sample), np.int64)
        for level in range(LEVELS):
            means = np.zeros((BRANCHES**level, BRANCHES, sample.shape[1]))
            for parent in range(len(means)):
                own = sample[word == parent]
                if len(own) > 2 * BRANCHES:
                    means[parent] = kmeans2(own, BRANCHES, iter=8, minit="points", seed=rng, missing="warn")[
                        0
                    ]
                else:
                    # Too few to part: the first branch takes all.
                    means[parent] = np.inf
                    means[parent, 0] = own.mean(axis=0) if len(own) else 0.0
            self._levels.append(means)
            word = self._descend(sample, word, means)

    def words(self, vectors: NDArray[np.float32]) -> NDArray[np.int64]:
        """(N,) word of each descriptor."""
        word = np.zeros(len(vectors), np.int64)
        for means in self._levels:
            word = self._descend(vectors, word, means)
        return word

    @staticmethod
    def _descend(vectors: NDArray[Any], word: NDArray[np.int64], means: NDArray[Any]) -> NDArray[np.int64]:
        out = np.empty(len(word), np.int64)
        order = np.argsort(word, kind="stable")
        for rows in np.split(order, np.flatnonzero(np.diff(word[order])) + 1):
            if len(rows):
                parent = int(word[rows[0]])
                there = np.isfinite(means[parent, :, 0])
                own = means[parent, there].astype(vectors.dtype)
                nearest = ((own * own).sum(axis=1) - 2 * (vectors[rows] @ own.T)).argmin(axis=1)
                out[rows] = parent * BRANCHES + np.flatnonzero(there)[nearest]
        return out


class WordIndex:
    """Nodes by tf-idf; answers like mapweave.mapserver.retrieval.place_index.PlaceIndex."""

    def __init__(
        self, nodes: Iterable[Node], vocabulary: Vocabulary, progress: Callable[[], None] = lambda: None
    ) -> None:
        """Count words."""
        self._vocabulary, self._size = vocabulary, BRANCHES**LEVELS
        self._ids: list[NodeId] = []
        words, lengths, rest = [], list[int](), iter(nodes)
        while some := list(islice(rest, AT_ONCE)):
            self._ids += [node.id for node in some]
            lengths += [len(node.landmarks) for node in some]
            words.append(vocabulary.words(decode(np.concatenate([node.landmarks.codes for node in some]))))
            for _ in some:
                progress()
        rows = np.repeat(np.arange(len(lengths)), lengths)
        counts = sparse.csr_matrix(
            (np.ones(len(rows)), (rows, np.concatenate(words))), shape=(len(lengths), self._size)
        )
        counts.sum_duplicates()
        occurs = np.bincount(counts.indices, minlength=self._size)
        self._idf = np.log(len(lengths) / np.maximum(occurs, 1))
        weighted = counts @ sparse.diags(self._idf)
        norms = np.sqrt(np.asarray(weighted.multiply(weighted).sum(axis=1)).ravel())
        self._by_word = (sparse.diags(1.0 / np.maximum(norms, 1e-9)) @ weighted).T.tocsr()

    def query(self, view: View, k: int = 5) -> Ranked:
        """The k nodes of the largest cosine with a view, best first."""
        words, counts = np.unique(self._vocabulary.words(decode(view.codes)), return_counts=True)
        scores = np.asarray((counts * self._idf[words]) @ self._by_word[words]).ravel()
        best = np.argpartition(-scores, min(k, len(scores) - 1))[:k]
        best = best[np.argsort(-scores[best], kind="stable")]
        return Ranked((self._ids[n], float(scores[n])) for n in best.tolist() if scores[n] > 0)
