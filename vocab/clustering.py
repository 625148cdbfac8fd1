"""k-means over byte descriptors, flat and in two levels, with the kernels' exact distances."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from seamark.vocab.kernels import native

TOP_SAMPLE = 256  # descriptors per cell that place the centres of the upper level: more move them by less than noise


def k_means(descriptors: NDArray[np.uint8], k: int, seed: int, iterations: int) -> NDArray[np.uint8]:
    """Cluster (n, 128) uint8 descriptors into ``k`` <= n centres, (k, 128) uint8 (Lloyd 1982).

    Starts at ``k`` descriptors drawn without replacement. Centres are rounded to bytes after each iteration; a cluster
    that runs empty takes the descriptor farthest from its centre. All arithmetic is exact, so that equal input and seed
    give equal bits on every machine.
    """
    random = np.random.default_rng(seed)
    centres = descriptors[np.sort(random.choice(len(descriptors), k, replace=False))]
    for _ in range(iterations):
        nearest, distance = _assign(centres, descriptors)
        centres = _means(descriptors, nearest, distance, centres)
    return centres


def two_level_k_means(
    descriptors: NDArray[np.uint8],
    k: int,
    n_cells: int,
    seed: int,
    iterations: int,
    report: Callable[[int], None],
) -> tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.int64]]:
    """Cluster into ``n_cells`` cells and those into ``k`` words in all, as many in a cell as its share of descriptors.

    Returns the words (k, 128) uint8 sorted by cell, the centres (n_cells, 128) uint8 and the offsets (n_cells + 1,)
    int64 of the cells' words (Nister and Stewenius, CVPR 2006, with two wide levels). ``report`` is called with the
    number of each cell that is done. Four rounds of flat refinement lowered the quantisation error by 1.5 %, on
    photographs by 0.2 %, left the recall of places as it was and made cells a worse guide to the nearest word.
    """
    random = np.random.default_rng(seed)
    some = np.sort(random.permutation(len(descriptors))[: TOP_SAMPLE * n_cells])
    centres = k_means(descriptors[some], n_cells, seed, iterations)
    cell, _ = _assign(centres, descriptors)
    members = np.split(np.argsort(cell, kind="stable"), np.cumsum(np.bincount(cell, minlength=n_cells))[:-1])
    shares = _shares(np.array([len(m) for m in members]), k)
    words = []
    for number, (member, share) in enumerate(zip(members, shares, strict=True)):
        if share:
            words.append(k_means(descriptors[member], int(share), seed + 1 + number, iterations))
        report(number + 1)
    return np.concatenate(words), centres, np.concatenate([[0], np.cumsum(shares)]).astype(np.int64)


def _assign(centres: NDArray[np.uint8], descriptors: NDArray[np.uint8]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    everything = np.array([0, len(centres)], np.int64)
    nearest, distance = native.Quantiser(centres, centres[:0], everything).assign(descriptors)
    return nearest[:, 0], distance[:, 0]


def _means(
    descriptors: NDArray[np.uint8], nearest: NDArray[np.int32], distance: NDArray[np.int32], centres: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    count = np.bincount(nearest, minlength=len(centres))
    filled = np.flatnonzero(count)
    starts = np.concatenate([[0], np.cumsum(count)[:-1]])[filled]
    grouped = descriptors[np.argsort(nearest, kind="stable")]
    sums = np.add.reduceat(grouped, starts, axis=0, dtype=np.uint32)
    half = count[filled, None] // 2
    means = centres.copy()
    means[filled] = (sums + half) // count[filled, None]
    empty = np.flatnonzero(count == 0)
    if len(empty):
        farthest = np.argsort(-distance, kind="stable")[: len(empty)]
        means[empty[: len(farthest)]] = descriptors[farthest]
    return means


def _shares(members: NDArray[np.intp], k: int) -> NDArray[np.int64]:
    """Split ``k`` in proportion to (n,) ``members``, no share greater than its members; the larger remainders first."""
    exact = members * (k / members.sum())
    shares = np.minimum(np.floor(exact).astype(np.int64), members)
    for cell in np.argsort(shares - exact, kind="stable"):
        if shares.sum() == k:
            break
        shares[cell] += shares[cell] < members[cell]
    return shares
