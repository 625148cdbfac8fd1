"""How much of the drift that is allowed for the loops of a map bear out."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from seamark.backend.chain import OdometryChains
from seamark.backend.consistency import odometry_cycles
from seamark.backend.graph_types import Constraint

# Shares of the allowed variance that are tried, the most cautious first.
SHARES: Final = (1.0, 0.25, 0.0625)
# A smaller share is believed only where a larger one makes the cycles less probable by this factor's logarithm (20).
SURE: Final = 3.0
MOST_LOOPS: Final = 500


def drift_share(loops: Sequence[Constraint], chains: OdometryChains, stretch: int) -> float:
    """Return which share of the odometry's allowed variance the cycles of loops and odometry show.

    A session's odometry is mostly far better than what a gate must allow for. The largest share is taken whose
    likelihood falls short of the best by less than ``SURE``. Loops that begin within ``stretch`` motions of each other
    count as one, for they close the same way. Loops between sessions and of sessions without metric scale say nothing.
    """
    within = [loop for loop in loops if _says(loop, chains)]
    within = within[:: -(-len(within) // MOST_LOOPS)] if within else []
    if not within:
        return SHARES[0]
    cycles = odometry_cycles(within, chains)
    places = np.array([(chains.node(x.query_id).session, chains.step(x.query_id) // stretch) for x in within])
    _, place, counts = np.unique(places, axis=0, return_inverse=True, return_counts=True)
    weights = 1 / counts[place.reshape(-1)]
    likelihoods = []
    for share in SHARES:
        C = share * cycles.odometry + cycles.loops
        chi2 = (cycles.error * np.linalg.solve(C, cycles.error[:, :, None])[:, :, 0]).sum(axis=1)
        likelihoods.append(-0.5 * float((weights * (chi2 + np.linalg.slogdet(C)[1])).sum()))
    best = max(likelihoods)
    return next(share for share, value in zip(SHARES, likelihoods, strict=True) if value >= best - SURE)


def _says(loop: Constraint, chains: OdometryChains) -> bool:
    query, match = chains.node(loop.query_id), chains.node(loop.match_id)
    return query.session == match.session and query.metric
