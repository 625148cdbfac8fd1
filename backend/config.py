"""Settings of the back end; units are in the names, the defaults work."""

from pydantic import BaseModel, ConfigDict, Field


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class VerificationConfig(_Section):
    """How two views are compared by geometry."""

    candidates: int = Field(default=5, ge=1, description="how many islands of candidates are verified per keyframe")
    island_keyframes: int = Field(
        default=3, ge=0, description="candidates this near to a verified one are not verified again"
    )
    min_gap_keyframes: int = Field(default=5, ge=1, description="candidates nearer in the same session are no loops")
    match_ratio: float = Field(default=0.85, gt=0, le=1, description="best over second-best descriptor distance")
    min_matches: int = Field(default=15, ge=8, description="descriptor matches below which geometry is not tried")
    reprojection_px: float = Field(default=3.0, gt=0, description="largest reprojection error of an inlier of a pose")
    epipolar_px: float = Field(default=1.5, gt=0, description="largest distance from the epipolar line")
    confidence: float = Field(default=0.9999, gt=0, lt=1, description="confidence at which sampling stops")
    iterations: int = Field(default=2000, ge=100, description="most samples drawn")
    min_inliers: int = Field(default=15, ge=6, description="inliers of a pose below which it is refused")
    min_inlier_ratio: float = Field(default=0.25, ge=0, le=1, description="inliers of a pose per match with depth")
    min_confirmed: float = Field(
        default=0.12, ge=0, le=1, description="share of the landmarks that a pose predicts which must be seen again"
    )
    min_explained: float = Field(
        default=0.65, ge=0, le=1, description="share of the matches without depth that a pose must explain"
    )
    max_rotation_sigma_deg: float = Field(
        default=1.0, gt=0, description="deviation of a pose's rotation, in its worst direction, that is refused"
    )
    max_translation_sigma_fraction: float = Field(
        default=0.05, gt=0, description="the same of its translation, per median depth of what is seen"
    )
    min_epipolar_inliers: int = Field(
        default=20, ge=9, description="inliers of epipolar geometry below which it is refused"
    )
    min_epipolar_ratio: float = Field(default=0.35, ge=0, le=1, description="inliers of epipolar geometry per match")
    min_hull_fraction: float = Field(
        default=0.015, ge=0, le=1, description="area of the inliers' hull per area of the image"
    )
    min_cells: int = Field(
        default=4, ge=1, description="cells of an 8 x 6 grid over the image that inliers must occupy"
    )
    noise_px: float = Field(
        default=0.5, gt=0, description="expected standard deviation of a key point; the matches themselves correct it"
    )
    shared_share: float = Field(
        default=0.1,
        ge=0,
        lt=1,
        description="share of its variance that key points of one cell of an 8 x 6 grid are expected to have in common",
    )
    shared_depth: float = Field(
        default=0.3, ge=0, description="the same of inverse depths, as a share of their standard deviation"
    )
    rotation_floor_deg: float = Field(default=0.005, gt=0, description="least standard deviation of a loop's rotation")
    translation_floor_fraction: float = Field(
        default=0.0002, gt=0, description="least standard deviation of a loop's translation per median depth"
    )
    rotation_systematic: float = Field(
        default=0.0005, ge=0, description="standard deviation of a loop's rotation per angle between the views"
    )
    translation_systematic: float = Field(
        default=0.005, ge=0, description="standard deviation of a loop's translation per distance between the views"
    )
    turn_systematic: float = Field(
        default=0.002, ge=0, description="the same per median depth and angle between the views"
    )
    depth_systematic: float = Field(
        default=0.7, ge=0, description="share of the deviation of depths by which all may be wrong alike"
    )
    excess_share: float = Field(
        default=2.0,
        ge=0,
        description="share of what reprojection errors exceed noise_px by that the whole view may be wrong by",
    )
    locate_inliers: int = Field(default=25, ge=6, description="inliers from which a single image is localised")
    min_scale_pairs: int = Field(
        default=10, ge=3, description="inliers with depth in both views needed for a loop's scale"
    )


class AlignmentConfig(_Section):
    """How the depth images of two keyframes refine the pose of a loop, or refuse it."""

    enabled: bool = Field(default=True, description="use depth images where both keyframes have one")
    samples: int = Field(default=2500, ge=200, description="points of each view that are looked for in the other")
    min_meeting: int = Field(default=200, ge=50, description="points that must meet the other surface to say anything")
    min_overlap: float = Field(
        default=0.15, ge=0, le=1, description="share of the points that must, else the pose stays as it was"
    )
    max_misfit: float = Field(
        default=5.0, gt=0, description="deviation of the surfaces per expected one above which it stays so"
    )
    max_shift_chi2: float = Field(
        default=22.46,
        gt=0,
        description="chi squared of the refined pose by the covariance of the first above which too",
    )
    max_through: float = Field(
        default=0.25,
        gt=0,
        le=1,
        description="share of what both see that lies where the other looks through, above which a loop is refused",
    )
    depth_sigma_floor_m: float = Field(
        default=0.003, gt=0, description="expected deviation of the small depth image at no distance"
    )
    depth_sigma_per_m2: float = Field(
        default=0.0025, gt=0, description="expected deviation at z metres is floor + this * z^2; residuals correct it"
    )
    shared_share: float = Field(
        default=0.3,
        ge=0,
        lt=1,
        description="share of its variance that depth of one cell of a 4 x 3 grid is expected to have in common",
    )
    shared_depth: float = Field(
        default=0.25, ge=0, description="what all readings of two views err by alike, per deviation at the median depth"
    )


class DriftConfig(_Section):
    """How far odometry may be wrong beyond its covariance.

    Visual odometry errs by a slowly varying bias and not by white noise: over a long way the error grows with the
    length and not with its root. Gates take the bias as it is; the graph, which knows white noise only, takes what
    gives the same error over ``horizon_keyframes``, or the share of it that loops bear out (``graph.learn_drift``).
    """

    covariance_inflation: float = Field(default=4.0, ge=1, description="factor on the odometry's covariances")
    translation_fraction: float = Field(
        default=0.01, ge=0, description="standard deviation of the bias per length of way"
    )
    mono_translation_fraction: float = Field(default=0.05, ge=0, description="the same where scale may drift too")
    rotation_fraction: float = Field(default=0.01, ge=0, description="standard deviation of the bias per angle turned")
    rotation_deg_per_keyframe: float = Field(
        default=0.05, ge=0, description="standard deviation of the bias per keyframe"
    )
    scale_per_keyframe: float = Field(
        default=0.02, gt=0, description="mono: standard deviation of log scale per root keyframe"
    )
    horizon_keyframes: int = Field(
        default=30, ge=1, description="keyframes over which white noise shall equal the bias"
    )
    floor_rotation_deg: float = Field(
        default=0.02, gt=0, description="least standard deviation of one motion's rotation"
    )
    floor_translation_m: float = Field(
        default=0.001, gt=0, description="least standard deviation of one motion's translation"
    )


class ConsistencyConfig(_Section):
    """When loops count as supporting or contradicting odometry and each other."""

    gate_chi2: float = Field(
        default=22.46, gt=0, description="largest chi squared of a loop against odometry (6 dof, 99.9 %)"
    )
    pair_chi2: float = Field(
        default=22.46, gt=0, description="largest chi squared of a cycle of two loops (6 dof, 99.9 %)"
    )
    strong_inliers: int = Field(
        default=60, ge=6, description="inliers that accept a loop that nothing contradicts alone"
    )
    support_keyframes: int = Field(
        default=10, ge=1, description="loops whose ends are this near to each other can confirm"
    )
    min_support: int = Field(
        default=1, ge=1, description="consistent neighbouring loops of other keyframes that confirm one"
    )
    compared_loops: int = Field(
        default=100, ge=2, description="nearest loops of the same sessions that one is compared with"
    )
    clique_starts: int = Field(default=20, ge=1, description="starts of the greedy clique search")
    lone_false_alarm: float = Field(
        default=1e-4,
        ge=0,
        le=1,
        description="chance to pass below which a loop alone is accepted",
    )
    contest_ratio: float = Field(
        default=2.0, ge=1, description="how much heavier than what contradicts it an accepted group must be"
    )


class GraphConfig(_Section):
    """The pose graph and its solver."""

    cauchy_width: float = Field(
        default=3.0, gt=0, description="width of the robust kernel of loops in standard deviations"
    )
    learn_drift: bool = Field(
        default=True, description="trust odometry more than ``drift`` says where the loops of the map bear it out"
    )
    prior_sigma: float = Field(default=1e-3, ge=1e-4, description="standard deviation of the first pose (rad, m)")
    relinearise_threshold: float = Field(
        default=0.01, gt=0, description="change (rad, m) from which iSAM2 relinearises"
    )
    incremental_updates: int = Field(default=5, ge=1, description="most iSAM2 iterations after a loop")
    batch_iterations: int = Field(default=50, ge=1, description="most Levenberg-Marquardt iterations")
    solve_wait_ms: float = Field(
        default=200.0, ge=0, description="a keyframe waits so long for its solution; a later one takes it up"
    )
    unknown_scale_sigma: float = Field(
        default=0.05, gt=0, description="log scale deviation of a mono loop read from disk"
    )


class PlacesConfig(_Section):
    """Mode places: when a recognised place counts without poses."""

    candidates: int = Field(default=10, ge=1, description="how many candidates are verified per image")
    island_images: int = Field(default=10, ge=0, description="of places this near to each other only the best counts")
    strong_inliers: int = Field(default=60, ge=9, description="inliers that accept a place alone")
    window_queries: int = Field(default=3, ge=1, description="how many images back or ahead can confirm a place")
    slack_images: int = Field(
        default=2, ge=0, description="how far matches may deviate from moving along with the queries"
    )
    min_support: int = Field(default=1, ge=1, description="neighbouring queries with matching places that confirm one")


class MapConfig(_Section):
    """What a map may take, and what is given up first when it takes more."""

    memory_mb: int = Field(
        default=256, ge=1, description="features kept in memory; others are read from the map when they are needed"
    )
    disk_mb: int = Field(default=20_000, ge=1, description="the map file; beyond it redundant views are forgotten")
    keyframes: int = Field(
        default=20_000, ge=2, description="keyframes that can be recognised; beyond it redundant views are forgotten"
    )
    place_m: float = Field(default=1.0, gt=0, description="views nearer to each other may stand for one another")
    place_deg: float = Field(default=20.0, gt=0, description="views whose directions differ by less may do so")
    lighting: float = Field(
        default=0.12, gt=0, le=1, description="views whose mean colours differ by less (0..1) show one lighting"
    )


class BackendConfig(_Section):
    """All settings of the back end."""

    verification: VerificationConfig = VerificationConfig()
    alignment: AlignmentConfig = AlignmentConfig()
    drift: DriftConfig = DriftConfig()
    consistency: ConsistencyConfig = ConsistencyConfig()
    graph: GraphConfig = GraphConfig()
    places: PlacesConfig = PlacesConfig()
    map: MapConfig = MapConfig()
