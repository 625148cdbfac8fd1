"""The people of a sequence: what they look like, where each part of them is at every frame, and how it moves."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from seamark.datasets_synth import crowd, figures, movers
from seamark.datasets_synth.figures import Figure
from seamark.datasets_synth.movers import Track
from seamark.datasets_synth.panels import Panel
from seamark.datasets_synth.specification import FPS, Specification
from seamark.frontend import se3


@dataclass(frozen=True, eq=False)
class People:
    """``figures`` and their ``tracks``, by number; ground truth of all that moves by itself."""

    figures: tuple[Figure, ...]
    tracks: tuple[Track, ...]

    def poses(self, person: int, index: int) -> NDArray[np.float64] | None:
        """Return T_world_part (P, 4, 4) of a person's parts at a frame; None for somebody who is not there."""
        track = self.tracks[person]
        if not track.present[index]:
            return None
        yaw, phase, pace = (float(column[index]) for column in (track.yaw, track.phase, track.pace))
        return self.figures[person].poses(track.position[index], yaw, phase, pace)

    def displacements(self, now: int, later: int) -> dict[int, se3.Matrix]:
        """Return by figures.label how parts move: T (4, 4) maps their points in the world from ``now`` to ``later``.

        Somebody who is missing in one of the frames, or was away in between, is left out.
        """
        out = {}
        for person, track in enumerate(self.tracks):
            if not track.present[min(now, later) : max(now, later) + 1].all():
                continue
            before, after = self.poses(person, now), self.poses(person, later)
            assert before is not None and after is not None
            for part, T in enumerate(after @ se3.inverse(before)):
                out[figures.label(person, part)] = T
        return out


def table(people: People, stamps_ns: NDArray[np.int64]) -> str:
    """Return where everybody is as CSV: a row per frame and part, with T_world_part as translation and quaternion."""
    rows = ["#stamp_ns,frame,person,label,part,tx,ty,tz,qx,qy,qz,qw"]
    for index, stamp in enumerate(stamps_ns.tolist()):
        for person in range(len(people.figures)):
            poses = people.poses(person, index)
            for part, T in enumerate(() if poses is None else poses):
                numbers = ",".join(f"{number:.9f}" for number in (*T[:3, 3], *se3.to_quaternion(T[:3, :3])))
                marked = figures.label(person, part)
                rows.append(f"{stamp},{index},{person},{marked},{figures.PARTS[part]},{numbers}")
    return "\n".join(rows) + "\n"


def people_of(specification: Specification, panels: Sequence[Panel] | None = None) -> People:
    """Return the people of a sequence, drawn from the seed of its motion.

    ``panels`` are those of its world, which is built where they are missing and a crowd has to find its way.
    """
    poses = specification.poses()
    if specification.crowd:
        panels = specification.build().panels if panels is None else panels
        space = crowd.FreeSpace(panels, poses)
        plan = crowd.Planner(poses, specification.rig.cam0, FPS, space, specification.crowd / 100)
        return People(*plan.fill(np.random.default_rng([specification.motion_seed, 0xC20])))
    bodies, tracks = [], []
    for number in range(specification.movers):
        rng = np.random.default_rng([specification.motion_seed, number, 0x9E0])
        bodies.append(figures.person(rng))
        tracks.append(movers.track(poses, FPS, specification.route.clearance_m, rng))
    return People(tuple(bodies), tuple(tracks))
