"""A crowd that hides a chosen share of the picture: people who come, cross, stand in the way and walk along.

Encounters are drawn at random, in the world and at the speed of people who walk; what each would hide is reckoned from
outlines, and those are kept that bring the share near to what is asked for and never far beyond it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.datasets_synth import figures
from seamark.datasets_synth.figures import Figure
from seamark.datasets_synth.movers import WALKING_M_S, Array, Track, Way, make_track, smoothed
from seamark.datasets_synth.panels import Panel
from seamark.frontend import se3
from seamark.frontend.camera import Camera

MOST_PEOPLE = 16
CELLS_PER_METRE = 10.0
MARGIN_M = 8.0  # of the map of free space about the way of the camera
BODY_Z_M = (0.12, 1.75)  # what lies between is in the way of somebody
ROOM_M = 0.27  # from the middle of somebody to what is in the way
ELBOW_M = 0.5  # from one to another
CAMERA_M = 0.62  # from the camera
FASTEST_M_S = 2.2
MASK = (160, 120)
NEAR_M, WIDEST = 0.1, 1.25  # what is nearer, or farther aside in terms of its depth, is out of the picture
SPARSELY = 6  # looks of which one is taken to refuse by
STEP = 3  # frames from one look at the picture to the next
UNSEEN, POPPING = 0.003, 0.02  # shares of the picture below which nobody is missed, and may appear at a distance
OUTLINE = 0.94  # of what coarse outlines cover is hidden
MOST_OVER = 1.15  # of the share asked for, by reckoning
TYPICAL = 0.3  # of the share asked for: what the median must reach before the crowd is large enough
PEAKS = 85  # percentile of shares from which on a frame is made a peak
TRIES = 8000
LEAD_S = 4.0  # that somebody may be about before and after an encounter


class FreeSpace:
    """A map of where somebody can stand, from the outlines of panels seen from above."""

    def __init__(self, panels: Sequence[Panel], T_world_cam: Array) -> None:
        place = T_world_cam[:, :2, 3]
        self._origin = place.min(axis=0) - MARGIN_M
        width, height = np.ceil((np.ptp(place, axis=0) + 2 * MARGIN_M) * CELLS_PER_METRE).astype(int).tolist()
        free = np.full((height, width), 255, np.uint8)
        for panel in panels:
            corners = panel.corners
            if panel.sky or corners[:, 2].max() < BODY_Z_M[0] or corners[:, 2].min() > BODY_Z_M[1]:
                continue
            outline = np.rint((corners[:, :2] - self._origin) * CELLS_PER_METRE).astype(np.int32)
            if (outline.max(axis=0) >= 0).all() and (outline.min(axis=0) < (width, height)).all():
                cv2.fillConvexPoly(free, outline, 0)
                cv2.polylines(free, [outline], True, 0)
        self._distance = cv2.distanceTransform(free, cv2.DIST_L2, 5) / CELLS_PER_METRE

    def room(self, places: Array) -> Array:
        """Return the distance (N,) m of places (N, 2) from what is in the way; 0 beyond the map."""
        cells = np.rint((places - self._origin) * CELLS_PER_METRE).astype(int)
        height, width = self._distance.shape
        inside = (cells >= 0).all(axis=1) & (cells < (width, height)).all(axis=1)
        cells = np.clip(cells, 0, (width - 1, height - 1))
        return np.where(inside, self._distance[cells[:, 1], cells[:, 0]], 0.0)


@dataclass(frozen=True, eq=False)
class Encounter:
    """Somebody at ``position`` (M, 2) m in the frames ``first`` to first + M; ``core`` is one of them that matters."""

    first: int
    core: int
    position: Array


class Planner:
    """Fills the sight of a camera on its way with people; ``share`` of the picture from 0 to 1."""

    def __init__(self, T_world_cam: Array, camera: Camera, fps: float, space: FreeSpace, share: float) -> None:
        self._poses, self._camera, self._fps, self._space, self._share = T_world_cam, camera, fps, space, share
        self._way = Way(T_world_cam)
        self._looks = np.arange(0, len(T_world_cam), STEP)
        self._hidden = np.zeros((len(self._looks), MASK[1], MASK[0]), np.uint8)
        # What is hidden goes with the square of the distance: fewer per cent, people farther away
        self._farther = float(np.clip(np.sqrt(0.25 / share), 0.75, 3.0))
        self.shares = np.zeros(len(self._looks))  # as reckoned, at every STEP-th frame

    def fill(self, rng: np.random.Generator) -> tuple[tuple[Figure, ...], tuple[Track, ...]]:
        """Return people and their tracks, drawn from ``rng``; fewer than wanted where the place has no room."""
        bodies = tuple(figures.person(rng) for _ in range(MOST_PEOPLE))
        count = len(self._poses)
        position, present = np.zeros((MOST_PEOPLE, count, 2)), np.zeros((MOST_PEOPLE, count), bool)
        kinds = (self._crossing, self._crossing, self._oncoming, self._ahead, self._ahead, self._standing)
        for _ in range(TRIES):
            if np.percentile(self.shares, 95) >= self._share and np.median(self.shares) >= TYPICAL * self._share:
                break
            core = self._wanting(rng)
            met = kinds[int(rng.integers(len(kinds)))](core, rng)
            if met is None:
                continue
            person = self._someone(met, present)
            kept = None if person is None else self._kept(met, bodies[person], position, present)
            if person is not None and kept is not None:
                frames = slice(kept.first, kept.first + len(kept.position))
                position[person, frames], present[person, frames] = kept.position, True
        used = [person for person in range(MOST_PEOPLE) if present[person].any()]
        tracks = tuple(make_track(position[person], present[person], self._fps) for person in used)
        return tuple(bodies[person] for person in used), tracks

    def _wanting(self, rng: np.random.Generator) -> int:
        """Return a frame that needs somebody: an empty one, or when there are few of these one near a peak."""
        if np.median(self.shares) < TYPICAL * self._share:
            return int(rng.choice(self._looks[self.shares <= TYPICAL * self._share]))
        below = np.where(self.shares < self._share, self.shares, 0)
        return int(rng.choice(self._looks[below >= np.percentile(below, PEAKS)]))

    def _someone(self, met: Encounter, present: NDArray[np.bool_]) -> int | None:
        """Return the first person who is free, with a pause before and after."""
        frames = slice(max(0, met.first - 1), met.first + len(met.position) + 1)
        free = np.flatnonzero(~present[:, frames].any(axis=1))
        return int(free[0]) if len(free) else None

    def _kept(self, met: Encounter, body: Figure, position: Array, present: NDArray[np.bool_]) -> Encounter | None:
        """Return the part of an encounter between entering and leaving the picture; None where it cannot be."""
        frames = np.arange(met.first, met.first + len(met.position))
        if not self._possible(met, position[:, frames], present[:, frames]):
            return None
        looks = np.flatnonzero(frames % STEP == 0)
        few = looks[::SPARSELY]
        alone = OUTLINE * self._outlines(met.position[few], frames[few], body).mean(axis=(1, 2))
        if alone.max(initial=0) > MOST_OVER * self._share:  # most are refused here, at a fraction of the cost
            return None
        masks = self._outlines(met.position[looks], frames[looks], body)
        own = masks.mean(axis=(1, 2))
        core = int(np.searchsorted(looks, met.core - met.first))
        before, after = np.flatnonzero(own[:core] < UNSEEN), np.flatnonzero(own[core:] < UNSEEN)
        begin = int(before[-1]) if len(before) else 0
        end = core + int(after[0]) if len(after) else len(own) - 1
        if end <= begin:
            return None
        begins, ends = own[begin] > POPPING and frames[looks[begin]] > STEP, own[end] > POPPING
        if begins or (ends and frames[looks[end]] < len(self._poses) - 2 * STEP):
            return None
        at = frames[looks[begin : end + 1]] // STEP
        together = self._hidden[at] | masks[begin : end + 1]
        share = OUTLINE * together.mean(axis=(1, 2))
        if share.max() > MOST_OVER * self._share:
            return None
        self._hidden[at], self.shares[at] = together, share
        first = looks[begin] if len(before) else 0
        last = looks[end] if len(after) else len(frames) - 1
        return Encounter(met.first + int(first), met.core, met.position[first : last + 1])

    def _possible(self, met: Encounter, others: Array, present: NDArray[np.bool_]) -> bool:
        """Return whether somebody can walk like that: not too fast, and into nothing and nobody."""
        frames = slice(met.first, met.first + len(met.position))
        speed = np.linalg.norm(np.diff(met.position, axis=0), axis=1) * self._fps
        if speed.max(initial=0) > FASTEST_M_S or self._space.room(met.position).min() < ROOM_M:
            return False
        if np.linalg.norm(met.position - self._way.place[frames], axis=1).min() < CAMERA_M:
            return False
        away = np.linalg.norm(others - met.position, axis=2)
        return bool(np.where(present, away, np.inf).min() > ELBOW_M)

    def _outlines(self, position: Array, frames: NDArray[np.int64], body: Figure) -> NDArray[np.uint8]:
        """Return masks (M, h, w) of where somebody would be seen in coarse pictures."""
        scale = np.array(MASK) / (self._camera.width, self._camera.height)
        masks = np.zeros((len(frames), MASK[1], MASK[0]), np.uint8)
        walk = make_track(position, np.ones(len(position), np.bool_), self._fps / STEP)
        hulls = _hulls(body)
        for number, (mask, frame) in enumerate(zip(masks, frames, strict=True)):
            T_cam_world = se3.inverse(self._poses[frame])
            yaw, phase, pace = (float(column[number]) for column in (walk.yaw, walk.phase, walk.pace))
            T_cam_part = T_cam_world @ body.poses(walk.position[number], yaw, phase, pace)
            for part, hull in hulls:
                points = se3.transform(T_cam_part[part], hull)
                points = points[points[:, 2] > NEAR_M]
                if len(points) < 3:
                    continue
                slope = points[:, :2] / points[:, 2:]
                length = np.linalg.norm(slope, axis=1, keepdims=True)
                slope *= np.minimum(1, WIDEST / np.maximum(length, 1e-9))  # beyond, models of lenses fold
                pixels = self._camera.project(np.column_stack([slope, np.ones(len(slope))]))
                outline = cv2.convexHull(np.rint(((pixels + 0.5) * scale - 0.5) * 16).astype(np.int32))
                cv2.fillConvexPoly(mask, outline, 1, cv2.LINE_8, 4)
        return masks

    # Encounters: each returns None where there is no room

    def _window(self, core: int, before_s: float, after_s: float) -> tuple[int, Array]:
        """Return the first frame of a time about ``core``, and the seconds (M,) since core."""
        first = max(0, core - int(before_s * self._fps))
        last = min(len(self._poses) - 1, core + int(after_s * self._fps))
        return first, (np.arange(first, last + 1) - core) / self._fps

    def _oncoming(self, core: int, rng: np.random.Generator) -> Encounter:
        """Somebody comes along the way of the camera and passes it."""
        first, t = self._window(core, 8.0, 3.0)
        side, speed = rng.choice([-1.0, 1.0]), rng.uniform(*WALKING_M_S)
        aside = side * rng.uniform(0.63, 0.95) + 0.08 * np.sin(rng.uniform(0.7, 1.5) * t + rng.uniform(0, 6))
        return Encounter(first, core, self._way.at(self._way.length[core] + 1.0 - speed * t, aside))

    def _ahead(self, core: int, rng: np.random.Generator) -> Encounter:
        """Somebody overtakes the camera or waits for it, walks ahead of it for a while, and goes off or falls back."""
        stays, near = rng.uniform(2.0, 8.0), rng.uniform(1.0, 2.4) * self._farther
        from_to = [rng.choice([-1.2, 7.5]), rng.choice([-1.2, 7.5])]
        leads = [abs(end - near) / rng.uniform(0.6, 0.95) for end in from_to]
        first, t = self._window(core, stays / 2 + leads[0], stays / 2 + leads[1])
        gone = np.clip((np.abs(t) - stays / 2) / np.where(t < 0, *leads), 0, 1)
        ends = np.where(t < 0, *from_to)
        distance = near + (ends - near) * gone**2 * (3 - 2 * gone) ** 1
        distance = distance + 0.2 * np.sin(rng.uniform(0.8, 1.6) * t + rng.uniform(0, 6))
        weave = rng.uniform(0.0, 0.35) * np.sin(rng.uniform(0.8, 1.6) * t + rng.uniform(0, 6))
        beside = np.clip((1.3 - distance) / 0.6, 0, 1)  # 1 while passing the camera
        aside = weave + beside * (rng.choice([-1.0, 1.0]) * 0.72 - weave)
        pace = smoothed(self._way.length[first : first + len(t), None], 0.5 * self._fps)[:, 0]
        return Encounter(first, core, self._way.at(pace + distance, aside))

    def _standing(self, core: int, rng: np.random.Generator) -> Encounter:
        """Somebody stands in the way and steps aside when the camera comes near."""
        first, t = self._window(core, 9.0, 4.0)
        spot = self._way.length[core] + rng.uniform(0.9, 1.4)
        away = spot - self._way.length[first : first + len(t)]
        steps = np.clip((rng.uniform(1.3, 1.7) - away) / 0.7, 0, 1)
        before, side = rng.uniform(-0.3, 0.3), rng.choice([-1.0, 1.0]) * rng.uniform(0.66, 0.8)
        shifting = 0.03 * np.sin(0.9 * t + rng.uniform(0, 6))
        aside = smoothed((before + steps * (side - before) + shifting)[:, None], 0.3 * self._fps)[:, 0]
        return Encounter(first, core, self._way.at(np.full(len(t), spot), aside))

    def _crossing(self, core: int, rng: np.random.Generator) -> Encounter | None:
        """Somebody comes into the picture, perhaps stands there for a while, and goes out to the other side or back."""
        eye, ahead = self._way.place[core], self._way.looking[core]
        left = np.array([-ahead[1], ahead[0]])
        depth = rng.uniform(0.9, 2.6) * self._farther
        spot = eye + depth * ahead + rng.uniform(-0.35, 0.35) * depth * left
        sight = eye + np.linspace(0.3, 1, 12)[:, None] * (spot - eye)
        if self._space.room(sight).min() < 0.1:
            return None
        comes = rng.choice([-1.0, 1.0]) * rng.uniform(0.7, 2.4)
        goes = comes + np.pi + rng.normal(0, 0.5) if rng.random() < 0.8 else comes
        speed, stands = rng.uniform(*WALKING_M_S), rng.choice([0.0, 0.0, rng.uniform(1.0, 5.0)])
        reach: list[Array] = []
        for angle in (comes, goes):
            direction = np.cos(angle) * ahead + np.sin(angle) * left
            steps = np.arange(0, 4.5, 0.1)
            blocked = self._space.room(spot + steps[:, None] * direction) < ROOM_M + 0.05
            length = steps[int(np.argmax(blocked)) - 1] if blocked.any() else steps[-1]
            if blocked[0] or length < 0.4:
                return None
            reach.append(length * direction)
        times = [float(np.linalg.norm(arm)) / speed for arm in reach]
        first, t = self._window(core, times[0] + stands / 2 + LEAD_S, times[1] + stands / 2 + LEAD_S)
        shares = [
            np.clip((sign * t - stands / 2) / time, 0, 1)[:, None] for sign, time in zip((-1, 1), times, strict=True)
        ]
        path = smoothed(spot + shares[0] * reach[0] + shares[1] * reach[1], 0.12 * self._fps)
        return Encounter(first, core, path)


def _hulls(body: Figure) -> list[tuple[int, Array]]:
    """Return points (N, 3) of every mesh that are enough for its outline, with the number of its part."""
    hulls = []
    for number, part in enumerate(body.parts):
        for mesh in part.meshes:
            rings = mesh.vertices.reshape(-1, figures.SEGMENTS + 1, 3)
            hulls.append((number, rings[1:-1, ::3].reshape(-1, 3).astype(np.float64)))
    return hulls
