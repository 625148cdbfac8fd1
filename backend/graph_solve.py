"""A pose graph file solved: which loops are believed, and where the nodes are; the live service's own acceptance."""

import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from seamark.backend.chain import OdometryChains
from seamark.backend.config import BackendConfig
from seamark.backend.consistency import odometry_chi2
from seamark.backend.g2o import GraphFile
from seamark.backend.graph_parts import GraphParts, split_graph
from seamark.backend.graph_types import Constraint, Estimate
from seamark.backend.judge import PoseJudge
from seamark.backend.ledger import Finding, Key, LoopHistory, LoopLedger
from seamark.backend.noise import LEAST_FACTOR, Noise, estimate_noise
from seamark.backend.pose_graph import PoseGraph
from seamark.backend.types import Reason
from seamark.backend.ways import ALL_AXES, PLANAR_AXES

# 99.9 per cent of chi squared with 3 and 6 degrees of freedom.
PLANAR_CHI2: Final = 16.27
SPATIAL_CHI2: Final = 22.46
# What is accepted here has passed sharper tests than a residual: the kernel is there for what is left.
CAUCHY_WIDTH: Final = 3.0
# Loops whose ends are this many nodes apart can support each other: nodes are frames here, not keyframes.
SUPPORT_NODES: Final = 20
# Live, the noise is estimated anew whenever the number of loops has doubled, first at this one.
FIRST_ESTIMATE: Final = 16


@dataclass(frozen=True)
class LoopVerdict:
    """A row of loops.csv: the file's edge, what is thought of it, its weight 0..1 in the solution and its history."""

    from_id: int
    to_id: int
    kept: bool
    reason: str
    weight: float
    added_at: int | None = None
    withdrawn_at: int | None = None
    withdrawals: int = 0


@dataclass(frozen=True, eq=False)
class GraphSolution:
    """``estimate`` of all nodes, one verdict per loop candidate in the file's direction, and what was found on the way.

    ``noise``: the factors on the file's covariances. ``seconds`` of CPU per stage.
    """

    planar: bool
    estimate: Estimate
    loops: tuple[LoopVerdict, ...]
    parts: int
    noise: Noise
    seconds: dict[str, float]


def graph_config(base: BackendConfig, planar: bool) -> BackendConfig:
    """Return the settings for files: their covariances, scaled by what the data say, stand for all of the drift."""
    drift = base.drift.model_copy(
        update={
            "covariance_inflation": LEAST_FACTOR,
            "translation_fraction": 0.0,
            "rotation_fraction": 0.0,
            "rotation_deg_per_keyframe": 0.0,
            "floor_rotation_deg": 1e-5,
            "floor_translation_m": 0.0,
        }
    )
    chi2 = PLANAR_CHI2 if planar else SPATIAL_CHI2
    consistency = base.consistency.model_copy(
        update={"gate_chi2": chi2, "pair_chi2": chi2, "support_keyframes": SUPPORT_NODES}
    )
    graph = base.graph.model_copy(update={"cauchy_width": CAUCHY_WIDTH, "learn_drift": False})
    return base.model_copy(update={"drift": drift, "consistency": consistency, "graph": graph})


def solve_graph(graph: GraphFile, live: bool = False, config: BackendConfig | None = None) -> GraphSolution:
    """Return the poses of all nodes and a verdict on every loop; ``live``: met one by one, later ones unknown.

    Raises BackendInputError where the graph contradicts itself, SolverError where it has no solution.
    """
    started = time.process_time()
    parts = split_graph(graph)
    run = (_Live if live else _Batch)(parts, graph_config(config or BackendConfig(), parts.planar))
    prepared = time.process_time()
    run.judge()
    judged = time.process_time()
    estimate = run.poses.optimise(thorough=True)
    solved = time.process_time()
    seconds = {"prepare": prepared - started, "judge": judged - prepared, "optimise": solved - judged}
    sessions = len({node.session for node in parts.nodes})
    return GraphSolution(parts.planar, estimate, run.verdicts(), sessions, run.noise, seconds)


class _Run:
    """The state that both ways of solving share: odometry, ledger, pose graph and what is committed to it."""

    def __init__(self, parts: GraphParts, config: BackendConfig) -> None:
        self.parts, self.config = parts, config
        self.poses = PoseGraph(config, parts.planar)
        self.start(Noise())
        self.session_of = {node.id: node.session for node in parts.nodes}
        self.committed: set[Key] = set()

    def start(self, noise: Noise) -> None:
        """Know nothing of any loop, and take this for the noise."""
        self.noise = noise
        self.refused: list[Constraint] = []
        self.chains = OdometryChains(self.config.drift)
        self.chains.inflate(noise.odometry / LEAST_FACTOR)
        self.ledger = LoopLedger(PoseJudge(self.chains, self.config.consistency, self.parts.planar))

    def estimate_noise(self, loops: Sequence[Constraint]) -> Noise:
        """Return what these loops say of the noise."""
        axes = PLANAR_AXES if self.parts.planar else ALL_AXES
        return estimate_noise(self.parts.nodes, loops, SUPPORT_NODES, axes, self.config.drift)

    def enter(self, loops: Sequence[Constraint]) -> dict[Key, Reason]:
        """Gate loops by odometry and judge what passes; return the verdicts that are new or changed."""
        scaled = [replace(loop, covariance=loop.covariance * self.noise.loops) for loop in loops]
        within = [x for x in scaled if self.session_of[x.query_id] == self.session_of[x.match_id]]
        chi2 = odometry_chi2(within, self.chains).tolist() if within else []
        far = {(x.query_id, x.match_id) for x, value in zip(within, chi2, strict=True) if not self._plausible(value)}
        self.refused += [loop for loop in loops if (loop.query_id, loop.match_id) in far]
        findings = [self._finding(loop) for loop in scaled if (loop.query_id, loop.match_id) not in far]
        return self.ledger.add_all(findings)

    def commit(self, verdicts: dict[Key, Reason]) -> bool:
        """Bring the pose graph in line with these verdicts; return whether it has changed."""
        accepted, withdrawn = [], []
        for key, reason in verdicts.items():
            constraint = self.ledger.finding(key).constraint
            if (reason == Reason.ACCEPTED) == (key in self.committed) or constraint is None:
                continue
            if reason == Reason.ACCEPTED:
                accepted.append(constraint)
            else:
                withdrawn.append(key)
        self.poses.add_loops(accepted)
        for key in withdrawn:
            self.poses.remove_loop(*key)
        self.committed = (self.committed | {constraint.key for constraint in accepted}) - set(withdrawn)
        return bool(accepted or withdrawn)

    def verdicts(self) -> tuple[LoopVerdict, ...]:
        """Return a row per loop candidate, duplicates last."""
        weights = self.poses.weights()
        rows = []
        for (from_id, to_id), loop in zip(self.parts.ends.tolist(), self.parts.loops, strict=True):
            key = (loop.query_id, loop.match_id)
            history = LoopHistory(Reason.ODOMETRY_DISAGREES)
            if key in self.ledger:
                history = self.ledger.history(key)
            kept = key in self.committed
            rows.append(
                LoopVerdict(
                    from_id,
                    to_id,
                    kept,
                    str(history.verdict),
                    weights.get(key, 0.0),
                    history.added_at,
                    history.withdrawn_at,
                    history.withdrawals,
                )
            )
        rows += [LoopVerdict(a, b, False, "duplicate", 0.0) for a, b in self.parts.duplicates.tolist()]
        return tuple(rows)

    def _plausible(self, chi2: float) -> bool:
        return chi2 <= self.config.consistency.gate_chi2

    def _finding(self, loop: Constraint) -> Finding:
        """A file has no inliers: every loop counts as weak."""
        weak = self.config.consistency.strong_inliers // 3
        sessions = (self.session_of[loop.query_id], self.session_of[loop.match_id])
        return Finding(loop.query_id, loop.match_id, *sessions, weak, loop)


class _Batch(_Run):
    """All loops are known at once."""

    def judge(self) -> None:
        """Fill the pose graph with what is believed."""
        noise = self.estimate_noise(self.parts.loops)
        verdicts = self._judge_all(noise)
        if noise.odometry > LEAST_FACTOR:
            # Odometry that seems bad may only have been charged with loops that are wrong by a little.
            believed = [x for x in self.parts.loops if verdicts.get((x.query_id, x.match_id)) == Reason.ACCEPTED]
            again = Noise(self.estimate_noise(believed).odometry, noise.loops)
            if again.odometry < noise.odometry:
                verdicts = self._judge_all(again)
        self.poses.add_keyframes(self.parts.nodes)
        self.commit(verdicts)

    def _judge_all(self, noise: Noise) -> dict[Key, Reason]:
        self.start(noise)
        self.chains.extend(self.parts.nodes)
        return self.enter(self.parts.loops)


class _Live(_Run):
    """Nodes come one by one, each with the loops whose later end it is; nothing is known of later ones."""

    def judge(self) -> None:
        """Fill the pose graph with what is believed at each node, and optimise whenever that has changed."""
        coming: dict[int, list[Constraint]] = defaultdict(list)
        for loop in self.parts.loops:
            coming[loop.query_id].append(loop)
        seen: list[Constraint] = []
        due = FIRST_ESTIMATE
        for node in self.parts.nodes:
            self.chains.add(node)
            self.poses.add_keyframe(node)
            seen += coming[node.id]
            again: list[Constraint] = []
            if len(seen) >= due:
                due = 2 * len(seen)
                again = self._learn_noise(seen)
            changed = [self.commit(self.enter([loop])) for loop in [*again, *coming[node.id]]]
            if any(changed):
                self.poses.optimise()

    def _learn_noise(self, seen: list[Constraint]) -> list[Constraint]:
        """Take the noise from the loops so far; where odometry is worse than thought return those to be tried again."""
        noise = self.estimate_noise(seen)
        believed = [loop for loop in seen if (loop.query_id, loop.match_id) in self.committed]
        if len(believed) >= FIRST_ESTIMATE:
            noise = Noise(self.estimate_noise(believed).odometry, noise.loops)
        worse = noise.odometry / self.noise.odometry
        self.noise = noise
        self.chains.inflate(worse)
        if worse <= 1:
            return []
        again, self.refused = self.refused, []
        return again
