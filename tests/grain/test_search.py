"""Own searches stand for scipy's, which takes long to import: the same answers to the last bit."""

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tsdf.grain.connected import components
from tsdf.grain.simplex import lowest

VALLEYS = {
    "smooth": lambda x: float(((x - np.arange(len(x))) ** 2 @ (1.0 + np.arange(len(x)))) + np.cos(3.0 * x[0])),
    "edges": lambda x: float(np.abs(x).max() + np.abs(x - 0.3).sum()),
    "steps": lambda x: float(np.floor(4.0 * np.abs(x)).sum()),  # equal values, and shrinking
}


@pytest.mark.parametrize("valley", VALLEYS)
def test_a_simplex_walks_as_scipys(valley):
    """From 20 starts in two and three dimensions: place and value are equal, to the last bit, and so is every step."""
    rng = np.random.default_rng(5)
    for start in [rng.normal(size=2 + k % 2) for k in range(20)]:
        corners = start + 0.3 * np.vstack([np.zeros(len(start)), np.eye(len(start))])
        seen = [], []

        def watched(x, where):
            where.append(x.tolist())
            return VALLEYS[valley](x)

        options = {"initial_simplex": corners, "xatol": 1e-6, "fatol": 1e-8, "maxiter": 400}
        theirs = minimize(watched, start, (seen[0],), method="Nelder-Mead", options=options)
        place, value = lowest(lambda x, where=seen[1]: watched(x, where), corners, 1e-6, 1e-8)
        assert seen[0] == seen[1]
        assert (place == theirs.x).all() and value == theirs.fun


@pytest.mark.parametrize("edges", [0, 1, 300, 700, 3000])
def test_components_are_scipys(edges):
    """Of random graphs of 1000 nodes, from no edge to many, and of a long chain in a bad order; numbers too."""
    rng = np.random.default_rng(edges)
    chain = rng.permutation(1000)
    for first, second in (rng.integers(1000, size=(2, edges)), (chain[:-1], chain[1:])):
        graph = coo_array((np.ones(len(first), np.int8), (first, second)), (1000, 1000))
        assert (components(first, second, 1000) == connected_components(graph, directed=False)[1]).all()
