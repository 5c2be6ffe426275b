"""Labelling by energy: minimum cuts, and alpha-expansion over them.

    E(f) = sum_i D_i(f_i) + sum_(i,j) w_ij [f_i != f_j]

is brought within a factor of two of its minimum by expansions (Boykov, Veksler and Zabih, "Fast approximate energy
minimization via graph cuts", PAMI 23, 2001): in turn each label is offered to all nodes, and a minimum cut tells which
of them should take it. scipy finds the flows, in whole numbers.
"""

from __future__ import annotations

import numpy as np

try:
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import breadth_first_order, maximum_flow
except ImportError as error:
    raise ImportError(
        "fisheyerec.baselines: expected scipy, which labelling by energy needs: pip install 'fisheyerec[baselines]'"
    ) from error

_LARGEST = 2.0**30  # flows are 32 bit


def energy(unary: np.ndarray, pairs: np.ndarray, weights: np.ndarray, labels: np.ndarray) -> float:
    """Evaluate E of labels (N,), arguments as in `alpha_expansion`."""
    apart = labels[pairs[:, 0]] != labels[pairs[:, 1]]
    return float(unary[np.arange(len(labels)), labels].sum() + weights[apart].sum())


def alpha_expansion(unary: np.ndarray, pairs: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Label nodes so that no expansion of one label lowers the energy.

    Args:
        unary: (N, L) D, what each label costs each node, not negative.
        pairs: (P, 2) indices of nodes.
        weights: (P,) w, what it costs to label a pair differently, not negative.

    Returns:
        (N,) indices of labels.
    """
    labels: np.ndarray = unary.argmin(-1)
    best, settled = energy(unary, pairs, weights, labels), 0
    alpha = 0
    while settled < unary.shape[1]:
        tried = np.where(_takers(unary, pairs, weights, labels, alpha), alpha, labels)
        lower = energy(unary, pairs, weights, tried)
        if lower < best - 1e-9 * abs(best):
            labels, best, settled = tried, lower, 0
        else:
            settled += 1
        alpha = (alpha + 1) % unary.shape[1]
    return labels


def _takers(unary: np.ndarray, pairs: np.ndarray, weights: np.ndarray, labels: np.ndarray, alpha: int) -> np.ndarray:
    """Which nodes take alpha in the best expansion: (N,) bool.

    With x = 1 for taking it, a pair's four costs are E00 + (E10 - E00) x_i - E10 x_j + (E01 + E10 - E00) (1 - x_i) x_j.
    """
    keeping, taking = unary[np.arange(len(labels)), labels], unary[:, alpha].copy()
    i, j = pairs.T
    both_keep = weights * (labels[i] != labels[j])
    j_takes, i_takes = weights * (labels[i] != alpha), weights * (labels[j] != alpha)
    np.add.at(taking, i, i_takes - both_keep)
    np.add.at(taking, j, -i_takes)
    return minimum_cut(taking - keeping, pairs, j_takes + i_takes - both_keep)


def minimum_cut(ones: np.ndarray, pairs: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Minimise sum_i ones_i x_i + sum_(i,j) weights_ij (1 - x_i) x_j over x in {0, 1}: (N,) bool.

    Args:
        ones: (N,) of either sign.
        pairs: (P, 2) indices of nodes.
        weights: (P,) not negative.
    """
    count = len(ones)
    source, sink, nodes = count, count + 1, np.arange(count)
    # What 1 costs is cut between source and node, what it saves between node and sink.
    tails = np.concatenate([np.full(count, source), nodes, pairs[:, 0]])
    heads = np.concatenate([nodes, np.full(count, sink), pairs[:, 1]])
    capacities = np.concatenate([np.maximum(ones, 0), np.maximum(-ones, 0), weights])
    whole = np.rint(capacities * (_LARGEST / max(float(capacities.sum()), 1e-200))).astype(np.int32)
    graph = csr_array((whole, (tails, heads)), shape=(count + 2, count + 2))
    residual = graph - maximum_flow(graph, source, sink).flow
    residual.eliminate_zeros()
    reached = breadth_first_order(residual, source, return_predecessors=False)
    x = np.ones(count + 2, dtype=bool)
    x[reached] = False
    return x[:count]
