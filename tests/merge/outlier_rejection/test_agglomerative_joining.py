"""Which pieces of map are joined first."""

from mapweave.hybridmap.ids import NodeId
from mapweave.merge.outlier_rejection.agglomerative_joining import joined

K = [NodeId("a", 1, k) for k in range(6)]
Key = tuple[NodeId, NodeId]


def keys(weights: dict[tuple[int, int], float]) -> dict[Key, float]:
    return {(K[a], K[b]): weight for (a, b), weight in weights.items()}


def pairs(result: list[Key]) -> list[tuple[int, int]]:
    return [(a.number, b.number) for a, b in result]


def test_joined_pieces_are_not_tested_again():
    """Each is the other's best, or the other's better ones are not tied to it by any link."""
    weights = keys({(0, 1): 9.0, (0, 2): 8.0, (0, 3): 7.0, (2, 3): 1.0, (4, 5): 2.0, (3, 4): 1.5})
    # 2 and 1 are tied by links that do not suffice: what 1 says of 2 is heard first.
    assert pairs(joined(weights, {*weights, (K[1], K[2])})) == [(0, 1), (4, 5)]
    # 3 waits for what 2 says of it.
    assert pairs(joined(weights, weights)) == [(0, 1), (0, 2), (4, 5)]
    # Weights that are no piece's best join nothing.
    assert pairs(joined(keys({(0, 1): 3.0, (1, 2): 2.0, (2, 3): 3.0}), ())) == [(0, 1), (2, 3)]
