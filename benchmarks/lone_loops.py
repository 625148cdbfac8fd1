"""How often a wrong loop would be believed alone: the false-alarm rate of the rule for lone loops.

    .venv/bin/python benchmarks/lone_loops.py twins office road [--seeds 20]

Two kinds of wrong loops are put to the rule (backend/judge.py). *As found*: every comparison of the course that
geometry verified and the truth refutes. *Moved*: every verified pose, right or wrong, with its covariance and inliers,
between other keyframes, drawn at random, for which it is wrong by more than half a metre or 10 degrees. Both are put to
a map that has no other loop, and to one that has all its right ones. Counted are those whose cycle closes (99.9 %),
those of them that have ``strong_inliers``, and those whose cycle is so tight that ``lone_false_alarm`` is met.
"""

import argparse
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from backend_worlds import FALSE_DEG, FALSE_M, Matrix
from loop_courses import COURSES, Replay, replay

from seamark.backend.chain import OdometryChains
from seamark.backend.config import BackendConfig
from seamark.backend.graph_types import Constraint
from seamark.backend.judge import PoseJudge
from seamark.backend.pose_graph import PoseGraph
from seamark.backend.slam import Slam
from seamark.backend.verify import Verification
from seamark.backend.verify_candidates import Verified
from seamark.frontend import se3
from seamark.frontend.types import Keyframe
from seamark.vocab.types import Candidates
from seamark.vocab.vocabulary import Vocabulary

MOVED_EACH = 50
Found = tuple[int, int, Verification]  # query, match and what geometry says


class RecordingSlam(Slam):
    """Keeps what geometry verified."""

    verified: list[Found]

    def _verify(self, keyframe: Keyframe, candidates: Candidates) -> Verified:
        found = super()._verify(keyframe, candidates)
        self.verified += [(keyframe.id, c.id, r) for c, r in found if isinstance(r, Verification)]
        return found

    def judge_who_knows(self, config: BackendConfig, loops: set[tuple[int, int]]) -> PoseJudge:
        """Return a judge who has heard odometry and believes those of these loops that were accepted."""
        chains = OdometryChains(config.drift)
        chains.extend(self._verdicts.nodes())
        judge = PoseJudge(chains, config.consistency)
        for loop in self.snapshot().loops:
            if loop.accepted and (loop.query_id, loop.match_id) in loops:
                judge.restore([self._verdicts.finding_of(loop, self._map.keyframes)])
        return judge


def wrong(T_match_query: Matrix, query: int, match: int, T_world_cam: Matrix) -> bool:
    E = np.linalg.inv(T_world_cam[query]) @ T_world_cam[match] @ T_match_query
    return bool(np.linalg.norm(E[:3, 3]) > FALSE_M or np.rad2deg(se3.rotation_angle(E[:3, :3])) > FALSE_DEG)


def moved(found: Sequence[Found], made: Replay, seed: int) -> Iterator[Found]:
    """Yield each verified pose between other keyframes of one session, where it is wrong."""
    rng = np.random.default_rng(seed)
    sessions = np.array([keyframe.session for keyframe in made.keyframes])
    for query, match, result in found:
        assert result.T_match_query is not None
        for _ in range(MOVED_EACH):
            match, query = np.sort(rng.choice(np.flatnonzero(sessions == rng.choice(sessions)), 2, replace=False))
            if query - match >= 5 and wrong(result.T_match_query, query, match, made.T_world_cam):
                yield int(query), int(match), result


def count(course: str, seed: int, vocabulary: Vocabulary, counts: dict[str, Counter[str]]) -> None:
    made, config = replay(course, seed, vocabulary=vocabulary), BackendConfig()
    slam = RecordingSlam(config, made.mode, PoseGraph(config), 1)
    slam.verified = []
    for keyframe, candidates in zip(made.keyframes, made.candidates, strict=True):
        slam.step(keyframe, candidates)
    slam.finish()
    posed = [each for each in slam.verified if each[2].T_match_query is not None]
    refuted = [(q, m, r) for q, m, r in posed if wrong(r.T_match_query, q, m, made.T_world_cam)]
    right = {(q, m) for q, m, _ in posed} - {(q, m) for q, m, _ in refuted}
    judges = {"no loop": slam.judge_who_knows(config, set()), "right loops": slam.judge_who_knows(config, right)}
    sessions = [keyframe.session for keyframe in made.keyframes]
    as_found = [(q, m, r) for q, m, r in refuted if sessions[q] == sessions[m]]
    for kind, loops in (("as found", iter(as_found)), ("moved", moved(posed, made, seed))):
        for query, match, result in loops:
            assert result.T_match_query is not None and result.covariance is not None
            loop = Constraint(query, match, result.T_match_query, result.covariance, result.scale, result.scale_sigma)
            for known, judge in judges.items():
                chance, counted = judge.lone_chance(loop), counts[f"{kind}, {known}"]
                counted["wrong"] += 1
                if chance is not None:
                    counted["closes"] += 1
                    counted["strong"] += result.inliers >= config.consistency.strong_inliers
                    counted["lone"] += chance <= config.consistency.lone_false_alarm


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("courses", nargs="+", choices=COURSES)
    parser.add_argument("--seeds", type=int, default=20)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    vocabulary = Vocabulary.default()
    print("| course | wrong loops, the map has | put to the rule | cycle closes | and strong | and so tight |")
    print("|---|---|---|---|---|---|")
    for course in options.courses:
        counts: dict[str, Counter[str]] = defaultdict(Counter)
        for seed in range(options.seeds):
            count(course, seed, vocabulary, counts)
        for kind, each in counts.items():
            cells = [str(each[name]) for name in ("wrong", "closes", "strong", "lone")]
            print("| " + " | ".join([course, kind, *cells]) + " |", flush=True)


if __name__ == "__main__":
    main()
