"""What a candidate that geometry supports has to pass to be a loop: odometry, then all other loops."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from seamark.backend.chain import OdometryChains
from seamark.backend.config import BackendConfig
from seamark.backend.consistency import gate_chi2
from seamark.backend.evidence import Evidence, Gate
from seamark.backend.graph_types import Constraint, Key, Node
from seamark.backend.judge import PoseJudge
from seamark.backend.judge_places import PlaceJudge
from seamark.backend.ledger import Finding, LoopLedger
from seamark.backend.types import Loop, Reason
from seamark.backend.verify import Rejected, Verification
from seamark.frontend.types import Keyframe, Mode
from seamark.vocab.types import Candidate


class LoopVerdicts:
    """Gates verified candidates by odometry, then has them judged with all findings so far.

    In mode places, which knows no poses, odometry says nothing and places are judged by their order. ``known`` are the
    keyframes of the map by id.
    """

    def __init__(self, config: BackendConfig, mode: Mode, nodes: Sequence[Node] = ()) -> None:
        self._config, self._places = config, mode == Mode.PLACES
        self._chains = OdometryChains(config.drift)
        self._ledger = LoopLedger(
            PlaceJudge(config.places, config.consistency)
            if self._places
            else PoseJudge(self._chains, config.consistency)
        )
        self.extend(nodes)

    def extend(self, nodes: Sequence[Node]) -> None:
        """Take in what odometry says of further keyframes; raises BackendInputError as the chains do."""
        if nodes:
            self._chains.extend(nodes)

    def nodes(self) -> tuple[Node, ...]:
        """Return the keyframes as odometry joins them, none in mode places."""
        return self._chains.nodes()

    def enter(
        self, query_id: int, candidate: Candidate, result: Verification | Rejected, known: Mapping[int, Keyframe]
    ) -> tuple[Loop, dict[Key, Reason]]:
        """Return the loop's row with its evidence, and the verdicts, its own perhaps among them, that it changes."""
        key, cues = (query_id, candidate.id), (candidate.score, candidate.votes, candidate.jeffrey)
        loop = Loop(*key, False, Reason.UNCONFIRMED, result.inliers, *cues, evidence=result.evidence)
        if isinstance(result, Rejected):
            return replace(loop, reason=result.reason), {}
        if not self._places:
            if result.T_match_query is None or result.covariance is None or not np.isfinite(result.scale_sigma):
                return replace(loop, reason=Reason.BAD_GEOMETRY), {}
            loop = replace(loop, T_match_query=result.T_match_query, covariance=result.covariance, scale=result.scale)
        finding = self.finding_of(loop, known, result.scale_sigma)
        if finding.constraint is not None and finding.query_session == finding.match_session:
            gate = self._odometry_gate(finding.constraint)
            loop = replace(loop, evidence=_with_gate(result.evidence, gate))
            if not gate.passed:
                return replace(loop, reason=Reason.ODOMETRY_DISAGREES), {}
        return loop, self._ledger.add(finding)

    def finding_of(self, loop: Loop, known: Mapping[int, Keyframe], scale_sigma: float | None = None) -> Finding:
        """Return what is judged of a loop; without ``scale_sigma`` the scale is as sure as its sessions allow."""
        query, match = known[loop.query_id], known[loop.match_id]
        constraint = None
        if loop.T_match_query is not None and loop.covariance is not None:
            known_scale = query.metric and match.metric
            if scale_sigma is None:
                scale_sigma = 1e-3 if known_scale else self._config.graph.unknown_scale_sigma
            constraint = Constraint(
                loop.query_id, loop.match_id, loop.T_match_query, loop.covariance, loop.scale, scale_sigma
            )
        return Finding(loop.query_id, loop.match_id, query.session, match.session, loop.inliers, constraint)

    def restore(self, findings: Sequence[Finding]) -> None:
        """Take in findings that were accepted in an earlier life, unasked."""
        self._ledger.restore(findings)

    def constraint(self, key: Key) -> Constraint | None:
        """Return what a finding tells the graph, None where it has no pose."""
        return self._ledger.finding(key).constraint

    def _odometry_gate(self, constraint: Constraint) -> Gate:
        chi2 = gate_chi2(constraint, self._chains)
        return Gate("odometry_chi2", chi2, self._config.consistency.gate_chi2, least=False)


def _with_gate(evidence: Evidence | None, gate: Gate) -> Evidence | None:
    return None if evidence is None else replace(evidence, gates=(*evidence.gates, gate))
