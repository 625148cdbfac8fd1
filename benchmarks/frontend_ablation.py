"""What each ingredient of the front end earns:  .venv/bin/python benchmarks/frontend_ablation.py DATA [LABEL...]

DATA is the folder with the real sequences. One run says little, so each real sequence is played four times: forward
and backward, and each of these in a mirror; beside them stand the RGB-D sequences at a third of their rate, where
flow fails, and a rendered walk through a crowd. A cell is the mean ATE
in metres of the poses as given at the frame (SE(3) alignment, Sim(3) for mono), of the longest session, and in brackets
the share of frames that were tracked in it, where that is not all of them.
"""

import argparse
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from real_sequences import REAL

from seamark.frontend import odometry, pose, session, tracker
from seamark.frontend.camera import Camera
from seamark.frontend.config import FrontendConfig
from seamark.frontend.flow import track as follow_flow
from seamark.frontend.odometry import Frontend
from seamark.frontend.types import Frame, Mode, Rig
from seamark.service.evaluation import Alignment, ate
from seamark.service.sources.open import open_sources
from seamark.service.types import Trajectory

CROWD = "synth:loop,trajectory=loop,frames=780,crowd=40,image=320x240"
MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])
SPARSE = 3
TANGENTIAL_X = 3  # place of the coefficient that changes its sign in a mirror


@dataclass(frozen=True)
class Play:
    """One way to see a sequence."""

    rig: Rig
    mode: Mode
    frames: list[Frame]
    truth: Trajectory


def without_return_check(*args: Any, **settings: Any) -> Any:
    return follow_flow(*args, **{**settings, "round_trip_px": 1e6})


def equal_votes(pixels: NDArray[np.floating], ages: NDArray[np.integer], camera: Camera) -> NDArray[np.float64]:
    return np.ones(len(pixels))


ABLATIONS: dict[str, tuple[dict[str, Any], list[tuple[Any, str, Any]]]] = {
    "all on": ({}, []),
    "window off": ({}, [(session.Session, "adjust_window", lambda self: None)]),
    "re-observation off": ({"revisit_keyframes": 0}, []),
    "keyframes that left the window do not hold it": ({"covisible_keyframes": 0}, []),
    "settling on keyframe patches off": ({}, [(odometry.tracker, "settle", lambda s, image, tracks, T: tracks)]),
    "descriptor fallback off": ({}, [(odometry, "recover", lambda *a: None)]),
    "return check of flow off": ({}, [(tracker.flow, "track", without_return_check)]),
    "correlation check of flow off": ({"flow_min_correlation": -1.0}, []),
    "motion prior of flow off": ({}, [(tracker, "predict_pixels", lambda s, tracks: tracks.pixels)]),
    "pose always from samples": ({}, [(pose, "CONTESTED_SHARE", 2.0)]),
    "votes by parts of the picture off": ({}, [(tracker, "static_votes", equal_votes)]),
    "gate that follows the noise off": ({}, [(session.Session, "gate_px", lambda self: self.config.pnp_threshold_px)]),
    "presumed distances off": ({}, [(session.Session, "_landmarks_presumed", lambda self: None)]),
    "disparity offset off": ({"disparity_systematic_px": 0.0}, []),
}


def sparse(play: Play) -> Play:
    """Return the play with every third frame only: motion between frames is three times as large."""
    return replace(play, frames=[replace(frame, index=i) for i, frame in enumerate(play.frames[::SPARSE])])


def mirrored_camera(camera: Camera) -> Camera:
    distortion = list(camera.distortion)
    if len(distortion) > TANGENTIAL_X:
        distortion[TANGENTIAL_X] *= -1
    return replace(camera, cx=camera.width - 1 - camera.cx, distortion=tuple(distortion))


def backward(play: Play) -> Play:
    last = play.frames[0].stamp_ns + play.frames[-1].stamp_ns
    frames = [replace(f, index=i, stamp_ns=last - f.stamp_ns) for i, f in enumerate(play.frames[::-1])]
    truth = Trajectory((last - play.truth.stamps_ns)[::-1].copy(), play.truth.T_world_cam[::-1].copy())
    return replace(play, frames=frames, truth=truth)


def mirrored(play: Play) -> Play:
    """Return the play in a mirror; of a rectified pair the right camera becomes the left one."""

    def flipped(image: NDArray[Any] | None) -> Any:
        return None if image is None else np.ascontiguousarray(image[:, ::-1])

    rig, poses = play.rig, play.truth.T_world_cam
    if rig.cam1 is not None and play.mode is Mode.STEREO:
        poses = poses @ rig.T_cam0_cam1
        rig = replace(rig, cam0=mirrored_camera(rig.cam1), cam1=mirrored_camera(rig.cam0))
        frames = [replace(f, image=flipped(f.image_right), image_right=flipped(f.image)) for f in play.frames]
    else:
        rig = replace(rig, cam0=mirrored_camera(rig.cam0))
        frames = [replace(f, image=flipped(f.image), depth=flipped(f.depth)) for f in play.frames]
    return replace(play, rig=rig, frames=frames, truth=Trajectory(play.truth.stamps_ns, MIRROR @ poses @ MIRROR))


def recorded(spec: str, mode: str) -> Play:
    source = open_sources([spec], mode=mode)
    assert source.ground_truth is not None
    assert source.rig is not None
    return Play(source.rig, source.mode, list(source.frames()), source.ground_truth)


def run(play: Play, config: FrontendConfig) -> tuple[float, float]:
    """Return the ATE (m) and the share of frames, from the first pose on, in the longest session."""
    frontend = Frontend(play.rig, play.mode, config)
    said = [frontend.step(frame).odometry for frame in play.frames]
    frontend.close()
    posed = [o for o in said if o.T_odom_cam is not None]
    if len(posed) < 3:
        return np.nan, 0.0
    session_id = Counter(o.session for o in posed).most_common(1)[0][0]
    longest = [o for o in posed if o.session == session_id]
    poses = np.stack([np.asarray(o.T_odom_cam) for o in longest])
    estimate = Trajectory(np.array([o.stamp_ns for o in longest]), poses)
    alignment = Alignment.SIM3 if play.mode is Mode.MONO else Alignment.SE3
    return ate(estimate, play.truth, alignment).translation_m.rmse, len(longest) / (len(said) - posed[0].index)


def cell(plays: list[Play], config: FrontendConfig) -> str:
    errors, shares = np.array([run(play, config) for play in plays]).T
    return f"{np.mean(errors):.4f}" + (f" ({100 * np.mean(shares):.0f} %)" if np.mean(shares) < 1 else "")


def rows(columns: list[list[Play]], labels: list[str]) -> Iterator[str]:
    for label, (settings, replacements) in ABLATIONS.items():
        if labels and label not in labels:
            continue
        kept = [(owner, name, getattr(owner, name)) for owner, name, _ in replacements]
        for owner, name, stand_in in replacements:
            setattr(owner, name, stand_in)
        yield " | ".join([label, *(cell(plays, FrontendConfig(**settings)) for plays in columns)])
        for owner, name, original in kept:
            setattr(owner, name, original)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("labels", nargs="*", help="some of the rows")
    parser.add_argument("--column", action="append", help="some of the columns")
    wish = parser.parse_intermixed_args()
    cv2.setNumThreads(1)
    columns = {}
    for name, (folder, mode) in REAL.items():
        forward = recorded(str(wish.data / folder), mode)
        columns[name] = [forward, backward(forward), mirrored(forward), mirrored(backward(forward))]
        if mode == "rgbd":
            columns[f"{name}, every third frame"] = [sparse(play) for play in columns[name]]
    columns["crowd at 320x240"] = [recorded(CROWD, "rgbd")]
    columns = {name: plays for name, plays in columns.items() if not wish.column or name in wish.column}
    print(" | ".join(["| off", *columns]) + " |")
    print("|" + "---|" * (len(columns) + 1))
    for line in rows(list(columns.values()), wish.labels):
        print(f"| {line} |", flush=True)


if __name__ == "__main__":
    main()
