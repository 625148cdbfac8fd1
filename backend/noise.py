"""How large the errors of a graph's odometry and loops are, by the cycles that they close.

The covariances of a file are taken as to their shape and multiplied by factors. Each cycle is drawn either from the
noise or from a uniform density over all poses (a false loop); the factor that makes all cycles most probable is taken.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from seamark.backend.chain import OdometryChains
from seamark.backend.config import DriftConfig
from seamark.backend.consistency import Cycles, odometry_cycles, pair_cycles
from seamark.backend.graph_types import Constraint, Node

Matrix = NDArray[np.float64]

# Twice the sigmas of a file is the least that experience allows: odometry errs by a bias that repeats, and
# loops err in common with their neighbours, which no difference between neighbours can show.
LEAST_FACTOR: Final = 4.0
ODOMETRY_FACTORS: Final = LEAST_FACTOR * np.array([1.0, 2.25, 4.0])
LOOP_FACTORS: Final = np.array([1.0, 4.0, 16.0])
MOST_CYCLES: Final = 2000
LEAST_CYCLES: Final = 5
ROUNDS: Final = 20


@dataclass(frozen=True)
class Noise:
    """Factors on the covariances of odometry and loops."""

    odometry: float = LEAST_FACTOR
    loops: float = LEAST_FACTOR


def estimate_noise(
    nodes: Sequence[Node], loops: Sequence[Constraint], support: int, axes: tuple[int, ...], drift: DriftConfig
) -> Noise:
    """Return the most probable factors; the least ones where there are too few cycles to say.

    ``support``: loops whose ends are at most so many steps apart are neighbours. ``axes``: those that can err.
    """
    chains = OdometryChains(drift.model_copy(update={"covariance_inflation": 1.0}))
    chains.extend(nodes)
    sides = np.maximum(chains.extent(), 1.0)
    everywhere = float(np.prod(sides[:2]) * 2 * np.pi if len(axes) == 3 else np.prod(sides) * 8 * np.pi**2)
    ends = np.array([[chains.node(i).session for i in (x.query_id, x.match_id)] for x in loops]).reshape(-1, 2)
    ones, others = _neighbours(loops, ends, support)
    loop_factor = LEAST_FACTOR
    if len(ones) >= LEAST_CYCLES:
        near = pair_cycles([loops[i] for i in ones], [loops[j] for j in others], chains)
        loop_factor *= _most_probable(near, LEAST_FACTOR, None, LOOP_FACTORS, axes, everywhere)
    within = [loop for loop, (a, b) in zip(loops, ends.tolist(), strict=True) if a == b][:MOST_CYCLES]
    odometry_factor = LEAST_FACTOR
    if len(within) >= LEAST_CYCLES:
        cycles = odometry_cycles(within, chains)
        odometry_factor = _most_probable(cycles, None, loop_factor, ODOMETRY_FACTORS, axes, everywhere)
    return Noise(odometry_factor, loop_factor)


def _neighbours(
    loops: Sequence[Constraint], sessions: NDArray[np.int64], support: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return pairs of loops that are near to each other at both ends, and not at the same query."""
    keys = np.array([(x.query_id, x.match_id) for x in loops]).reshape(-1, 2)
    ones, others = [], []
    for i in range(len(loops)):
        stop = int(np.searchsorted(keys[:, 0], keys[i, 0] + support, side="right"))
        j = np.arange(i + 1, stop)
        j = j[(np.abs(keys[j, 1] - keys[i, 1]) <= support) & (keys[j, 0] > keys[i, 0])]
        j = j[(sessions[j] == sessions[i]).all(axis=1)]
        ones.append(np.full(len(j), i))
        others.append(j)
    first, second = (np.concatenate([np.zeros(0, np.int64), *parts]) for parts in (ones, others))
    stride = max(1, len(first) // MOST_CYCLES)
    return first[::stride], second[::stride]


def _most_probable(
    cycles: Cycles,
    odometry: float | None,
    loops: float | None,
    factors: NDArray[np.float64],
    axes: tuple[int, ...],
    everywhere: float,
) -> float:
    """Return the factor, of odometry or of loops (the one given as None), with the largest likelihood."""
    index = np.array(axes)
    error = cycles.error[:, index]
    likelihoods = []
    for factor in factors.tolist():
        C = cycles.odometry * (odometry or factor) + cycles.loops * (loops or factor)
        C = C[:, index[:, None], index]
        chi2 = (error * np.linalg.solve(C, error[:, :, None])[:, :, 0]).sum(axis=1)
        inlier = np.exp(-0.5 * chi2) / np.sqrt((2 * np.pi) ** len(axes) * np.linalg.det(C))
        share = 0.5
        for _ in range(ROUNDS):  # expectation maximisation of the share of sound cycles
            odds = share * inlier
            share = float(np.clip(np.mean(odds / (odds + (1 - share) / everywhere)), 0.01, 0.99))
        likelihoods.append(float(np.log(share * inlier + (1 - share) / everywhere).sum()))
    return float(factors[int(np.argmax(likelihoods))])
