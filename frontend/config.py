"""Configuration of the front end; every default works for hand-held, driving and flying cameras alike."""

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class FrontendConfig(BaseModel):
    """Thresholds and sizes of the front end."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    # Corners and their tracks
    corner_detector: Literal["harris", "shi_tomasi", "harris_laplace"] = Field(
        "shi_tomasi", description="corner response; harris_laplace takes corners of all scales, at ten times the cost"
    )
    mask_file: Path | None = Field(None, description="image of the camera's size, black where nothing is to be used")
    motion_masks: bool = Field(True, description="say what moves while the camera stands still")
    max_corners: int = Field(420, ge=50, le=5000, description="tracked corners per image, spread by grid")
    min_corner_response: float = Field(2e-5, gt=0, description="floor of the Shi-Tomasi response (image in 0..1)")
    flow_window_px: int = Field(21, ge=5, le=29, description="side of the Lucas-Kanade patch; odd, else one more")
    flow_levels: int = Field(4, ge=0, le=8, description="highest level of the Lucas-Kanade pyramid")
    flow_round_trip_px: float = Field(0.8, gt=0, description="forward-backward distance that a good track stays under")
    flow_min_correlation: float = Field(
        0.4, ge=-1, le=1, description="zero-mean normalised correlation of a good track's patch with the one before"
    )

    # Motion
    pnp_threshold_px: float = Field(2.5, gt=0, description="reprojection error of a RANSAC inlier")
    pnp_iterations: int = Field(100, ge=10, le=10000, description="RANSAC samples at most; recovery takes six times")
    pixel_sigma: float = Field(0.7, gt=0, description="standard deviation of a tracked corner in pixels")
    min_inliers: int = Field(15, ge=6, description="fewer inliers than this mean that the pose is not known")
    good_inliers: int = Field(40, ge=6, description="from this many inliers on the pose is GOOD, below MARGINAL")

    # Depth
    depth_min_m: float = Field(0.2, gt=0, description="readings and stereo matches nearer are ignored")
    depth_max_m: float = Field(10.0, gt=0, description="RGB-D readings beyond are ignored")
    depth_sigma_floor_m: float = Field(0.003, gt=0, description="sigma of an RGB-D reading at no distance")
    depth_sigma_per_m2: float = Field(0.0035, gt=0, description="sigma of a reading at z metres is floor + this * z^2")
    disparity_sigma_px: float = Field(0.4, gt=0, description="standard deviation of a stereo match")
    disparity_systematic_px: float = Field(
        0.3, ge=0, description="expected error of the rig's calibration, in disparity; learned on the way, 0: is none"
    )
    min_disparity_px: float = Field(0.5, gt=0, description="stereo matches with less are taken as unknown")

    # Keyframes and the local window
    keyframe_max_gap_s: float = Field(2.0, gt=0, description="a keyframe at least this often while the camera moves")
    keyframe_parallax_px: float = Field(
        35.0, gt=0, description="median parallax, rotation taken out, of a new keyframe"
    )
    keyframe_rotation_deg: float = Field(15.0, gt=0, description="rotation of a new keyframe against the last")
    keyframe_tracked_ratio: float = Field(0.6, gt=0, lt=1, description="share of the keyframe's landmarks still seen")
    keyframe_shared_ratio: float = Field(
        0.4,
        ge=0,
        lt=1,
        description="share of the tracks of the map's last keyframe, still followed, above which "
        "a keyframe of the window is not worth one of the map",
    )
    window_keyframes: int = Field(8, ge=3, le=30, description="keyframes adjusted together")
    window_iterations: int = Field(4, ge=1, le=50, description="Levenberg-Marquardt steps at most")

    covisible_keyframes: int = Field(
        8, ge=0, le=30, description="keyframes that have left the window, share its landmarks and hold it"
    )

    # Earlier keyframes, seen again
    archive_keyframes: int = Field(60, ge=0, le=1000, description="keyframes kept with their image after the window")
    revisit_keyframes: int = Field(3, ge=0, le=20, description="earlier keyframes tried at a new keyframe")
    revisit_angle_deg: float = Field(20.0, gt=0, description="largest turn against an archived keyframe")
    revisit_step: float = Field(0.3, gt=0, description="largest distance from one, per median depth of the scene")
    revisit_search_px: float = Field(15.0, gt=0, description="how far from its expected pixel a landmark may be found")
    revisit_min_landmarks: int = Field(12, ge=4, description="landmarks seen again that make a keyframe an anchor")

    # Mono initialisation
    initial_parallax_px: float = Field(18.0, gt=0, description="median parallax before two views are tried")
    initial_min_landmarks: int = Field(50, ge=10, description="landmarks of a first map at least")
    triangulation_min_angle_deg: float = Field(0.9, gt=0, description="angle between the rays to a new landmark")

    # Stamps
    clock_back_frames: int = Field(
        5, ge=2, description="frames in ascending order before the newest stamp: the clock was set back"
    )
    clock_jump_s: float = Field(10.0, gt=0, description="a stamp farther ahead waits for the next to confirm it")

    # Loss and recovery
    patience_s: float = Field(0.6, gt=0, description="sensor time without a pose after which a new session starts")
    recovery_keyframes: int = Field(3, ge=1, le=20, description="recent keyframes tried by descriptors when flow fails")

    # What a keyframe carries
    sift_features: int = Field(1000, ge=100, le=10000, description="strongest key points kept")
    sift_contrast: float = Field(0.015, gt=0, lt=1, description="contrast threshold of SIFT (Lowe 2004)")
    sift_pixels: int = Field(180_000, ge=10_000, description="larger images are reduced to so many pixels for SIFT")
    jpeg_quality: int = Field(85, ge=30, le=100, description="of the image that the map keeps")
    keyframe_depth_px: int = Field(
        0,
        ge=0,
        le=1280,
        description="least width of the depth image that an RGB-D keyframe carries, 0 for none; 160"
        " lets surfaces refine and refuse loops",
    )
    thumbnail_px: int = Field(96, ge=16, le=640, description="longer side of the copy for colour histograms")
