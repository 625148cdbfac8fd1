"""How hard the synthetic worlds are to see, beside real data: key points, matches, tracks, revisits, aliasing.

    .venv/bin/python benchmarks/worlds.py [WORLD ...] [--images docs/images/worlds]

Prints Markdown tables (all worlds, then the real sequences) and writes a contact sheet per world and one of the
conditions. SIFT with at most 1000 points, ratio 0.8, fundamental matrix with MAGSAC at 1.5 px; KLT with 300 corners
and a forward-backward check at 0.7 px over bursts of 30 frames.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.datasets_synth import scenarios, sensor, specification, world_office
from seamark.datasets_synth.rendering import render_some
from seamark.datasets_synth.specification import Specification
from seamark.datasets_synth.worlds import WORLDS

DATA = Path(__file__).resolve().parent.parent.parent / "shared" / "data"
PLACES, BURST, AHEAD = 12, 30, 5
BURST_AT = (1, 5, 9)
UNRELATED_M = 8.0
THUMBNAIL = (320, 240)
Image = NDArray[np.uint8]
Features = tuple[NDArray[np.float32], NDArray[np.float32]]


def sift(image: Image) -> Features:
    points, descriptors = cv2.SIFT_create(1000, enable_precise_upscale=True).detectAndCompute(image, None)
    if descriptors is None:
        return np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32)
    return np.array([point.pt for point in points], np.float32), descriptors


def match(a: Features, b: Features) -> tuple[int, int]:
    """Return how many descriptors match and how many of those agree with one fundamental matrix."""
    if min(len(a[0]), len(b[0])) < 8:
        return 0, 0
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(a[1], b[1], 2)
    good = [(one.queryIdx, one.trainIdx) for one, two in pairs if one.distance < 0.8 * two.distance]
    if len(good) < 8:
        return len(good), 0
    first, second = a[0][[i for i, _ in good]], b[0][[j for _, j in good]]
    _, mask = cv2.findFundamentalMat(first, second, cv2.USAC_MAGSAC, 1.5, 0.999, 2000)
    return len(good), 0 if mask is None else int(mask.sum())


def track(images: Sequence[Image]) -> tuple[float, list[int]]:
    """Return which share of tracks survives a frame, and for how many frames the corners of the first are followed."""
    grey = [cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in images]
    points = cv2.goodFeaturesToTrack(grey[0], 300, 0.01, 10)
    if points is None:
        return 0.0, [0]
    lives, shares = [0] * len(points), []
    alive = np.arange(len(points))
    for before, after in pairwise(grey):
        if len(points) == 0:
            break
        moved, ok, _ = cv2.calcOpticalFlowPyrLK(before, after, points, None)
        back, ok_back, _ = cv2.calcOpticalFlowPyrLK(after, before, moved, None)
        inside = (moved[:, 0] > 0).all(axis=1) & (moved[:, 0] < (before.shape[1], before.shape[0])).all(axis=1)
        good = (ok.ravel() > 0) & (ok_back.ravel() > 0) & inside
        good &= np.linalg.norm((back - points)[:, 0], axis=1) < 0.7
        shares.append(float(good.mean()))
        alive, points = alive[good], moved[good]
        for number in alive:
            lives[number] += 1
    return float(np.mean(shares)), lives


def render(wanted: Specification, indices: Sequence[int]) -> dict[int, Image]:
    frames = render_some(wanted, indices)
    return {coded.index: np.asarray(sensor.decode(coded, 0, str(coded.index)).image) for coded in frames}


def cell(values: Sequence[float]) -> str:
    """Return median, least and most."""
    return "-" if not len(values) else f"{np.median(values):.0f} ({min(values):.0f}..{max(values):.0f})"


def unrelated(features: Sequence[Features], apart: NDArray[np.bool_]) -> list[float]:
    count = len(features)
    return [match(features[i], features[j])[1] for i in range(count) for j in range(i) if apart[i, j]]


def nearest(poses: NDArray[np.float64], wanted: NDArray[np.float64]) -> list[int]:
    """Return for every wanted pose (M, 4, 4) the pose that is nearest, one radian of turning counting as 3 m."""
    angles = np.arccos(np.clip(np.einsum("nk,mk->mn", poses[:, :3, 2], wanted[:, :3, 2]), -1, 1))
    distances = np.linalg.norm(poses[None, :, :3, 3] - wanted[:, None, :3, 3], axis=2)
    return [int(k) for k in np.argmin(distances + 3 * angles, axis=1)]


def world_row(name: str, images: Path) -> list[str]:
    day = specification.parse(f"{name},sensors=mono")
    poses = day.poses()
    places = np.linspace(0.02 * len(poses), 0.85 * len(poses), PLACES).astype(int).tolist()
    bursts = [list(range(places[k], places[k] + BURST)) for k in BURST_AT]
    seen = render(day, sorted({*places, *(index for burst in bursts for index in burst)}))
    features = {index: sift(image) for index, image in seen.items()}
    matched = [match(features[burst[k]], features[burst[k + AHEAD]])[0] for burst in bursts for k in (0, 10, 20)]
    tracked = [track([seen[index] for index in burst]) for burst in bursts]
    closed = day.route.closed
    second = replace(
        day, trajectory="second_traversal" if closed else day.trajectory, run=1, offset=0 if closed else 30
    )
    later = nearest(second.poses(), poses[places])
    again = render(second, sorted(set(later)))
    revisit = [match(features[a], sift(again[b]))[1] for a, b in zip(places, later, strict=True)]
    dark = render(replace(day, condition="night", camera="real"), places)
    night = [match(features[index], sift(dark[index]))[1] for index in places]
    where = poses[places][:, :3, 3]
    apart = np.linalg.norm(where[:, None] - where[None], axis=2) > UNRELATED_M
    row = [name, cell([len(f[0]) for f in features.values()]), cell(matched)]
    row += [
        f"{100 * np.mean([share for share, _ in tracked]):.1f}",
        cell([life for _, lives in tracked for life in lives]),
    ]
    row += [cell(revisit), cell(night), cell(unrelated([features[index] for index in places], apart))]
    row.append(cell(alike(name, poses, places, features, day)))
    thumbnails = [seen[index] for index in places[::2]] + [dark[index] for index in places[1::5]]
    write_sheet(images / f"{name}.png", thumbnails, 3)
    return row


def alike(
    name: str, poses: NDArray[np.float64], places: list[int], features: dict[int, Features], day: Specification
) -> list[float]:
    """Return the inliers between views that the world repeats on purpose: half a turn in twins, next door in office."""
    if name == "twins":
        twin, near = np.diag([-1.0, -1.0, 1.0, 1.0]) @ poses[places], np.abs(poses[places][:, 0, 3]) < 9
    elif name == "office":
        twin, near = poses[places].copy(), np.ones(len(places), dtype=bool)
        twin[:, 0, 3] += np.where(twin[:, 0, 3] > 0, -1, 1) * world_office.PITCH_M
    else:
        return []
    alike = nearest(poses, twin)
    apart = np.linalg.norm(poses[alike][:, :3, 3] - twin[:, :3, 3], axis=1)
    same_way = np.einsum("nk,nk->n", poses[alike][:, :3, 2], twin[:, :3, 2]) > np.cos(np.deg2rad(15))
    good = np.flatnonzero(near & (apart < 0.5) & same_way)
    views = render(day, sorted({alike[k] for k in good}))
    return [match(features[places[k]], sift(views[alike[k]]))[1] for k in good]


def real_rows() -> Iterator[list[str]]:
    """Yield the same figures of real sequences, as far as they have them."""
    for name, folder, pattern in (
        ("TUM fr1_rpy", "tum_fr1_rpy/rgb", "*.*"),
        ("RGB-D HoloLens", "rgbd_hololens/rgb", "*.*"),
        ("KITTI 06, 0-50", "kitti06_stereo_000-050/image_0", "*.*"),
    ):
        files = sorted((DATA / folder).glob(pattern))
        starts = [int(share * (len(files) - BURST)) for share in (0.1, 0.5, 0.9)]
        bursts = [[cv2.imread(str(file)) for file in files[start : start + BURST]] for start in starts]
        features = [[sift(image) for image in burst] for burst in bursts]
        matched = [match(some[k], some[k + AHEAD])[0] for some in features for k in (0, 10, 20)]
        tracked = [track(burst) for burst in bursts]
        row = [name, cell([len(f[0]) for some in features for f in some]), cell(matched)]
        row.append(f"{100 * np.mean([share for share, _ in tracked]):.1f}")
        row += [cell([life for _, lives in tracked for life in lives]), "-", "-", "-", "-"]
        yield row
    for name, one, two in (
        ("Gardens Point, day left/right", "gardens_point/day_left", "gardens_point/day_right"),
        ("VPR-Bench corridor (160x120)", "vpr_corridor/ref", "vpr_corridor/query"),
    ):
        first, second = (sorted((DATA / folder).glob("*.jpg")) for folder in (one, two))
        chosen = np.linspace(5, min(len(first), len(second)) - 6, PLACES).astype(int).tolist()
        features = [[sift(cv2.imread(str(files[k]))) for k in chosen] for files in (first, second)]
        revisit = [match(a, b)[1] for a, b in zip(*features, strict=True)]
        apart = ~np.eye(PLACES, dtype=bool)
        row = [name, cell([len(f[0]) for f in features[0]]), "-", "-", "-"]
        yield [*row, cell(revisit), "-", cell(unrelated(features[0], apart)), "-"]


def write_sheet(path: Path, images: Sequence[Image], columns: int) -> None:
    """Write thumbnails as a PNG of few colours, which keeps the file small."""
    small = [cv2.resize(image, THUMBNAIL, interpolation=cv2.INTER_AREA) for image in images]
    small += [np.zeros_like(small[0])] * (-len(small) % columns)
    rows = [np.hstack(small[start : start + columns]) for start in range(0, len(small), columns)]
    sheet = cv2.medianBlur(np.vstack(rows), 3)
    path.parent.mkdir(parents=True, exist_ok=True)
    for step in (8, 16, 24, 32, 48):
        coarse = (sheet // step * step + step // 2).astype(np.uint8)
        data = cv2.imencode(".png", coarse, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes()
        if len(data) < 390_000:
            break
    path.write_bytes(data)


def conditions_sheet(images: Path) -> None:
    """Write one sheet: rows are worlds, columns day, dusk, night, the end of a change, and people in a barrel lens."""
    views = []
    for name, share in (("loop", 0.3), ("street", 0.12)):
        for more in ("", ",condition=dusk,camera=real", ",condition=night,camera=real", ",camera=barrel,movers=3"):
            wanted = specification.parse(f"{name},sensors=mono{more}")
            index = int(share * wanted.frames)
            views.append(render(wanted, [index])[index])
    write_sheet(images / "conditions.png", views, 4)


def crowd_sheet(images: Path) -> None:
    """Write one sheet of people, from a moving camera with motion blur and from one that stands still."""
    views = []
    for name, indices in (("crowd_stereo", (100, 430, 520)), ("onlooker", (60, 150, 500))):
        wanted = specification.parse(scenarios.expand(f"{name},sensors=mono"))
        views += list(render(wanted, indices).values())
    write_sheet(images / "crowd.png", views, 3)


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("worlds", nargs="*", default=list(WORLDS))
    arguments.add_argument("--images", type=Path, default=Path("docs/images/worlds"))
    chosen = arguments.parse_args()
    cv2.setNumThreads(1)
    titles = ("", "SIFT points", f"matches {AHEAD} frames on", "KLT survival %", f"KLT life of {BURST}")
    titles += ("revisit inliers", "day-night inliers", "unrelated inliers", "alike places")
    print("| " + " | ".join(titles) + " |\n" + "|---" * len(titles) + "|", flush=True)
    for name in chosen.worlds:
        print("| " + " | ".join(world_row(name, chosen.images)) + " |", flush=True)
    if DATA.is_dir():
        for row in real_rows():
            print("| " + " | ".join(row) + " |", flush=True)
    else:
        print(f"no real data at {DATA}")
    conditions_sheet(chosen.images)
    crowd_sheet(chosen.images)


if __name__ == "__main__":
    main()
