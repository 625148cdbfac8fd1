"""All loops that geometry found, the verdict on each, which later ones may change, and its history."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from seamark.backend.errors import BackendInputError
from seamark.backend.graph_types import Constraint
from seamark.backend.types import Reason

Key = tuple[int, int]


@dataclass(frozen=True, eq=False)
class Finding:
    """A loop that geometry supports: keyframe ids, sessions, inliers and, where poses are known, the constraint."""

    query_id: int
    match_id: int
    query_session: int
    match_session: int
    inliers: int
    constraint: Constraint | None = None

    @property
    def key(self) -> Key:
        """The pair of keyframes, which names the loop."""
        return self.query_id, self.match_id

    @property
    def sessions(self) -> tuple[int, int]:
        """The sessions of query and match."""
        return self.query_session, self.match_session


class Judge(Protocol):
    """Who decides which findings are accepted; findings are numbered in the order in which they were entered."""

    def enter(self, findings: Sequence[Finding]) -> Mapping[int, Reason]:
        """Take in findings; return the verdicts, by number, that are new or may have changed."""

    def restore(self, findings: Sequence[Finding]) -> None:
        """Take in findings that were accepted in an earlier life, unasked."""


@dataclass(frozen=True)
class LoopHistory:
    """What became of a loop.

    ``verdict`` today; ``added_at`` and ``withdrawn_at`` the query keyframe whose findings last had the loop accepted
    and withdrawn, None for never; ``withdrawals`` how often it was withdrawn.
    """

    verdict: Reason
    added_at: int | None = None
    withdrawn_at: int | None = None
    withdrawals: int = 0


class LoopLedger:
    """Findings, what the judge says of them, and what became of each; a later verdict may overturn an earlier one."""

    def __init__(self, judge: Judge) -> None:
        self._judge = judge
        self._findings: list[Finding] = []
        self._numbers: dict[Key, int] = {}
        self._histories: list[LoopHistory] = []

    def __contains__(self, key: Key) -> bool:
        return key in self._numbers

    def add(self, finding: Finding) -> dict[Key, Reason]:
        """Enter a finding; return the verdicts that are new or changed."""
        return self.add_all([finding])

    def add_all(self, findings: Sequence[Finding]) -> dict[Key, Reason]:
        """Enter findings that are to be judged at once; return the verdicts that are new or changed.

        Raises BackendInputError for a pair of keyframes that was entered before.
        """
        if not findings:
            return {}
        first = len(self._findings)
        for finding in findings:
            self._append(finding, LoopHistory(Reason.UNCONFIRMED))
        verdicts = self._judge.enter(findings)
        at = max(finding.query_id for finding in findings)
        changes = {}
        for number, verdict in sorted(verdicts.items()):
            if number >= first or verdict != self._histories[number].verdict:
                self._histories[number] = _turned(self._histories[number], verdict, at)
                changes[self._findings[number].key] = verdict
        return changes

    def restore(self, findings: Sequence[Finding]) -> None:
        """Enter findings that were accepted in an earlier life, unasked."""
        for finding in findings:
            self._append(finding, LoopHistory(Reason.ACCEPTED, finding.query_id))
        self._judge.restore(findings)

    def finding(self, key: Key) -> Finding:
        """Return the finding of this pair of keyframes."""
        return self._findings[self._numbers[key]]

    def history(self, key: Key) -> LoopHistory:
        """Return what became of the loop of this pair of keyframes."""
        return self._histories[self._numbers[key]]

    def _append(self, finding: Finding, history: LoopHistory) -> None:
        if finding.key in self._numbers:
            raise BackendInputError(f"loop {finding.query_id} to {finding.match_id} was found twice")
        self._numbers[finding.key] = len(self._findings)
        self._findings.append(finding)
        self._histories.append(history)


def _turned(history: LoopHistory, verdict: Reason, at: int) -> LoopHistory:
    """Return the history with a new verdict."""
    accepted, was_accepted = verdict == Reason.ACCEPTED, history.verdict == Reason.ACCEPTED
    history = replace(history, verdict=verdict)
    if accepted and not was_accepted:
        return replace(history, added_at=at)
    if was_accepted and not accepted:
        return replace(history, withdrawn_at=at, withdrawals=history.withdrawals + 1)
    return history
