"""Connected: which nodes of a graph hang together.

Here and not scipy's, which takes longer to import than a grain of a million facets takes.
"""

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]


def components(first: Ints, second: Ints, count: int) -> Ints:
    """Return for each of `count` nodes the component that it is of, numbered by their first nodes, (count,) int64.

    The lower label goes from the label of one end of an edge to that of the other, and every label takes the label of
    its own node, until none changes (Shiloach & Vishkin 1982).

    Parameters
    ----------
    first, second : (k,) int64
        Nodes that edges join, in [0, count).
    """
    label = np.arange(count)
    while len(first):
        one, other = label[first], label[second]
        differ = one != other
        first, second, one, other = first[differ], second[differ], one[differ], other[differ]
        np.minimum.at(label, np.maximum(one, other), np.minimum(one, other))
        while (label != (shorter := label[label])).any():
            label = shorter
    return np.unique(label, return_inverse=True)[1]
