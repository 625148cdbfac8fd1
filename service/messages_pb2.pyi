from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Array(_message.Message):
    __slots__ = ("data", "shape", "dtype")
    DATA_FIELD_NUMBER: _ClassVar[int]
    SHAPE_FIELD_NUMBER: _ClassVar[int]
    DTYPE_FIELD_NUMBER: _ClassVar[int]
    data: bytes
    shape: _containers.RepeatedScalarFieldContainer[int]
    dtype: str
    def __init__(self, data: _Optional[bytes] = ..., shape: _Optional[_Iterable[int]] = ..., dtype: _Optional[str] = ...) -> None: ...

class Image(_message.Message):
    __slots__ = ("raw", "encoded")
    RAW_FIELD_NUMBER: _ClassVar[int]
    ENCODED_FIELD_NUMBER: _ClassVar[int]
    raw: Array
    encoded: bytes
    def __init__(self, raw: _Optional[_Union[Array, _Mapping]] = ..., encoded: _Optional[bytes] = ...) -> None: ...

class Camera(_message.Message):
    __slots__ = ("width", "height", "fx", "fy", "cx", "cy", "distortion")
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    FX_FIELD_NUMBER: _ClassVar[int]
    FY_FIELD_NUMBER: _ClassVar[int]
    CX_FIELD_NUMBER: _ClassVar[int]
    CY_FIELD_NUMBER: _ClassVar[int]
    DISTORTION_FIELD_NUMBER: _ClassVar[int]
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, width: _Optional[int] = ..., height: _Optional[int] = ..., fx: _Optional[float] = ..., fy: _Optional[float] = ..., cx: _Optional[float] = ..., cy: _Optional[float] = ..., distortion: _Optional[_Iterable[float]] = ...) -> None: ...

class Frame(_message.Message):
    __slots__ = ("schema_version", "index", "stamp_ns", "file", "image", "image_right", "depth", "mask")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    INDEX_FIELD_NUMBER: _ClassVar[int]
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    FILE_FIELD_NUMBER: _ClassVar[int]
    IMAGE_FIELD_NUMBER: _ClassVar[int]
    IMAGE_RIGHT_FIELD_NUMBER: _ClassVar[int]
    DEPTH_FIELD_NUMBER: _ClassVar[int]
    MASK_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    index: int
    stamp_ns: int
    file: str
    image: Image
    image_right: Image
    depth: Image
    mask: Image
    def __init__(self, schema_version: _Optional[int] = ..., index: _Optional[int] = ..., stamp_ns: _Optional[int] = ..., file: _Optional[str] = ..., image: _Optional[_Union[Image, _Mapping]] = ..., image_right: _Optional[_Union[Image, _Mapping]] = ..., depth: _Optional[_Union[Image, _Mapping]] = ..., mask: _Optional[_Union[Image, _Mapping]] = ...) -> None: ...

class Features(_message.Message):
    __slots__ = ("points", "scales", "angles", "descriptors")
    POINTS_FIELD_NUMBER: _ClassVar[int]
    SCALES_FIELD_NUMBER: _ClassVar[int]
    ANGLES_FIELD_NUMBER: _ClassVar[int]
    DESCRIPTORS_FIELD_NUMBER: _ClassVar[int]
    points: Array
    scales: Array
    angles: Array
    descriptors: Array
    def __init__(self, points: _Optional[_Union[Array, _Mapping]] = ..., scales: _Optional[_Union[Array, _Mapping]] = ..., angles: _Optional[_Union[Array, _Mapping]] = ..., descriptors: _Optional[_Union[Array, _Mapping]] = ...) -> None: ...

class Keyframe(_message.Message):
    __slots__ = ("schema_version", "id", "session", "index", "stamp_ns", "file", "features", "landmarks", "thumbnail", "jpeg", "camera", "previous_id", "T_odom_cam", "covariance", "metric", "depth")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    INDEX_FIELD_NUMBER: _ClassVar[int]
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    FILE_FIELD_NUMBER: _ClassVar[int]
    FEATURES_FIELD_NUMBER: _ClassVar[int]
    LANDMARKS_FIELD_NUMBER: _ClassVar[int]
    THUMBNAIL_FIELD_NUMBER: _ClassVar[int]
    JPEG_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    PREVIOUS_ID_FIELD_NUMBER: _ClassVar[int]
    T_ODOM_CAM_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    METRIC_FIELD_NUMBER: _ClassVar[int]
    DEPTH_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    id: int
    session: int
    index: int
    stamp_ns: int
    file: str
    features: Features
    landmarks: Array
    thumbnail: Array
    jpeg: bytes
    camera: Camera
    previous_id: int
    T_odom_cam: Array
    covariance: Array
    metric: bool
    depth: bytes
    def __init__(self, schema_version: _Optional[int] = ..., id: _Optional[int] = ..., session: _Optional[int] = ..., index: _Optional[int] = ..., stamp_ns: _Optional[int] = ..., file: _Optional[str] = ..., features: _Optional[_Union[Features, _Mapping]] = ..., landmarks: _Optional[_Union[Array, _Mapping]] = ..., thumbnail: _Optional[_Union[Array, _Mapping]] = ..., jpeg: _Optional[bytes] = ..., camera: _Optional[_Union[Camera, _Mapping]] = ..., previous_id: _Optional[int] = ..., T_odom_cam: _Optional[_Union[Array, _Mapping]] = ..., covariance: _Optional[_Union[Array, _Mapping]] = ..., metric: _Optional[bool] = ..., depth: _Optional[bytes] = ...) -> None: ...

class Filled(_message.Message):
    __slots__ = ("index", "stamp_ns", "session", "reference_id", "T_reference_cam")
    INDEX_FIELD_NUMBER: _ClassVar[int]
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_ID_FIELD_NUMBER: _ClassVar[int]
    T_REFERENCE_CAM_FIELD_NUMBER: _ClassVar[int]
    index: int
    stamp_ns: int
    session: int
    reference_id: int
    T_reference_cam: Array
    def __init__(self, index: _Optional[int] = ..., stamp_ns: _Optional[int] = ..., session: _Optional[int] = ..., reference_id: _Optional[int] = ..., T_reference_cam: _Optional[_Union[Array, _Mapping]] = ...) -> None: ...

class Stage(_message.Message):
    __slots__ = ("name", "ms")
    NAME_FIELD_NUMBER: _ClassVar[int]
    MS_FIELD_NUMBER: _ClassVar[int]
    name: str
    ms: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, name: _Optional[str] = ..., ms: _Optional[_Iterable[float]] = ...) -> None: ...

class Odometry(_message.Message):
    __slots__ = ("schema_version", "index", "stamp_ns", "file", "session", "quality", "outcome", "inliers", "reprojection_px", "latency_ms", "T_odom_cam", "reference_id", "T_reference_cam", "covariance", "keyframe_id", "filled", "tracks", "stages_ms", "near_share", "loss", "track_ages", "motion_mask")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    INDEX_FIELD_NUMBER: _ClassVar[int]
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    FILE_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    QUALITY_FIELD_NUMBER: _ClassVar[int]
    OUTCOME_FIELD_NUMBER: _ClassVar[int]
    INLIERS_FIELD_NUMBER: _ClassVar[int]
    REPROJECTION_PX_FIELD_NUMBER: _ClassVar[int]
    LATENCY_MS_FIELD_NUMBER: _ClassVar[int]
    T_ODOM_CAM_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_ID_FIELD_NUMBER: _ClassVar[int]
    T_REFERENCE_CAM_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    KEYFRAME_ID_FIELD_NUMBER: _ClassVar[int]
    FILLED_FIELD_NUMBER: _ClassVar[int]
    TRACKS_FIELD_NUMBER: _ClassVar[int]
    STAGES_MS_FIELD_NUMBER: _ClassVar[int]
    NEAR_SHARE_FIELD_NUMBER: _ClassVar[int]
    LOSS_FIELD_NUMBER: _ClassVar[int]
    TRACK_AGES_FIELD_NUMBER: _ClassVar[int]
    MOTION_MASK_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    index: int
    stamp_ns: int
    file: str
    session: int
    quality: str
    outcome: str
    inliers: int
    reprojection_px: float
    latency_ms: float
    T_odom_cam: Array
    reference_id: int
    T_reference_cam: Array
    covariance: Array
    keyframe_id: int
    filled: _containers.RepeatedCompositeFieldContainer[Filled]
    tracks: Array
    stages_ms: _containers.RepeatedCompositeFieldContainer[Stage]
    near_share: float
    loss: str
    track_ages: Array
    motion_mask: Array
    def __init__(self, schema_version: _Optional[int] = ..., index: _Optional[int] = ..., stamp_ns: _Optional[int] = ..., file: _Optional[str] = ..., session: _Optional[int] = ..., quality: _Optional[str] = ..., outcome: _Optional[str] = ..., inliers: _Optional[int] = ..., reprojection_px: _Optional[float] = ..., latency_ms: _Optional[float] = ..., T_odom_cam: _Optional[_Union[Array, _Mapping]] = ..., reference_id: _Optional[int] = ..., T_reference_cam: _Optional[_Union[Array, _Mapping]] = ..., covariance: _Optional[_Union[Array, _Mapping]] = ..., keyframe_id: _Optional[int] = ..., filled: _Optional[_Iterable[_Union[Filled, _Mapping]]] = ..., tracks: _Optional[_Union[Array, _Mapping]] = ..., stages_ms: _Optional[_Iterable[_Union[Stage, _Mapping]]] = ..., near_share: _Optional[float] = ..., loss: _Optional[str] = ..., track_ages: _Optional[_Union[Array, _Mapping]] = ..., motion_mask: _Optional[_Union[Array, _Mapping]] = ...) -> None: ...

class PlaceObservation(_message.Message):
    __slots__ = ("schema_version", "id", "session", "stamp_ns", "descriptors", "points", "thumbnail", "scales", "angles")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    DESCRIPTORS_FIELD_NUMBER: _ClassVar[int]
    POINTS_FIELD_NUMBER: _ClassVar[int]
    THUMBNAIL_FIELD_NUMBER: _ClassVar[int]
    SCALES_FIELD_NUMBER: _ClassVar[int]
    ANGLES_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    id: int
    session: int
    stamp_ns: int
    descriptors: Array
    points: Array
    thumbnail: Array
    scales: Array
    angles: Array
    def __init__(self, schema_version: _Optional[int] = ..., id: _Optional[int] = ..., session: _Optional[int] = ..., stamp_ns: _Optional[int] = ..., descriptors: _Optional[_Union[Array, _Mapping]] = ..., points: _Optional[_Union[Array, _Mapping]] = ..., thumbnail: _Optional[_Union[Array, _Mapping]] = ..., scales: _Optional[_Union[Array, _Mapping]] = ..., angles: _Optional[_Union[Array, _Mapping]] = ...) -> None: ...

class Candidate(_message.Message):
    __slots__ = ("id", "score", "votes", "jeffrey", "view")
    ID_FIELD_NUMBER: _ClassVar[int]
    SCORE_FIELD_NUMBER: _ClassVar[int]
    VOTES_FIELD_NUMBER: _ClassVar[int]
    JEFFREY_FIELD_NUMBER: _ClassVar[int]
    VIEW_FIELD_NUMBER: _ClassVar[int]
    id: int
    score: float
    votes: float
    jeffrey: float
    view: float
    def __init__(self, id: _Optional[int] = ..., score: _Optional[float] = ..., votes: _Optional[float] = ..., jeffrey: _Optional[float] = ..., view: _Optional[float] = ...) -> None: ...

class Candidates(_message.Message):
    __slots__ = ("schema_version", "query_id", "stamp_ns", "ranked")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    QUERY_ID_FIELD_NUMBER: _ClassVar[int]
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    RANKED_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    query_id: int
    stamp_ns: int
    ranked: _containers.RepeatedCompositeFieldContainer[Candidate]
    def __init__(self, schema_version: _Optional[int] = ..., query_id: _Optional[int] = ..., stamp_ns: _Optional[int] = ..., ranked: _Optional[_Iterable[_Union[Candidate, _Mapping]]] = ...) -> None: ...

class Loop(_message.Message):
    __slots__ = ("schema_version", "query_id", "match_id", "accepted", "reason", "inliers", "score", "votes", "jeffrey", "T_match_query", "covariance", "scale")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    QUERY_ID_FIELD_NUMBER: _ClassVar[int]
    MATCH_ID_FIELD_NUMBER: _ClassVar[int]
    ACCEPTED_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    INLIERS_FIELD_NUMBER: _ClassVar[int]
    SCORE_FIELD_NUMBER: _ClassVar[int]
    VOTES_FIELD_NUMBER: _ClassVar[int]
    JEFFREY_FIELD_NUMBER: _ClassVar[int]
    T_MATCH_QUERY_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    SCALE_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    query_id: int
    match_id: int
    accepted: bool
    reason: str
    inliers: int
    score: float
    votes: float
    jeffrey: float
    T_match_query: Array
    covariance: Array
    scale: float
    def __init__(self, schema_version: _Optional[int] = ..., query_id: _Optional[int] = ..., match_id: _Optional[int] = ..., accepted: _Optional[bool] = ..., reason: _Optional[str] = ..., inliers: _Optional[int] = ..., score: _Optional[float] = ..., votes: _Optional[float] = ..., jeffrey: _Optional[float] = ..., T_match_query: _Optional[_Union[Array, _Mapping]] = ..., covariance: _Optional[_Union[Array, _Mapping]] = ..., scale: _Optional[float] = ...) -> None: ...

class MapSnapshot(_message.Message):
    __slots__ = ("schema_version", "revision", "keyframe_ids", "sessions", "components", "T_map_cam", "scales", "loops")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    REVISION_FIELD_NUMBER: _ClassVar[int]
    KEYFRAME_IDS_FIELD_NUMBER: _ClassVar[int]
    SESSIONS_FIELD_NUMBER: _ClassVar[int]
    COMPONENTS_FIELD_NUMBER: _ClassVar[int]
    T_MAP_CAM_FIELD_NUMBER: _ClassVar[int]
    SCALES_FIELD_NUMBER: _ClassVar[int]
    LOOPS_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    revision: int
    keyframe_ids: Array
    sessions: Array
    components: Array
    T_map_cam: Array
    scales: Array
    loops: _containers.RepeatedCompositeFieldContainer[Loop]
    def __init__(self, schema_version: _Optional[int] = ..., revision: _Optional[int] = ..., keyframe_ids: _Optional[_Union[Array, _Mapping]] = ..., sessions: _Optional[_Union[Array, _Mapping]] = ..., components: _Optional[_Union[Array, _Mapping]] = ..., T_map_cam: _Optional[_Union[Array, _Mapping]] = ..., scales: _Optional[_Union[Array, _Mapping]] = ..., loops: _Optional[_Iterable[_Union[Loop, _Mapping]]] = ...) -> None: ...

class PlaceQuery(_message.Message):
    __slots__ = ("schema_version", "image", "top_k", "camera")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    IMAGE_FIELD_NUMBER: _ClassVar[int]
    TOP_K_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    image: bytes
    top_k: int
    camera: Camera
    def __init__(self, schema_version: _Optional[int] = ..., image: _Optional[bytes] = ..., top_k: _Optional[int] = ..., camera: _Optional[_Union[Camera, _Mapping]] = ...) -> None: ...

class Direction(_message.Message):
    __slots__ = ("R_match_query", "bearing", "rotation_sigma", "bearing_sigma")
    R_MATCH_QUERY_FIELD_NUMBER: _ClassVar[int]
    BEARING_FIELD_NUMBER: _ClassVar[int]
    ROTATION_SIGMA_FIELD_NUMBER: _ClassVar[int]
    BEARING_SIGMA_FIELD_NUMBER: _ClassVar[int]
    R_match_query: Array
    bearing: Array
    rotation_sigma: float
    bearing_sigma: float
    def __init__(self, R_match_query: _Optional[_Union[Array, _Mapping]] = ..., bearing: _Optional[_Union[Array, _Mapping]] = ..., rotation_sigma: _Optional[float] = ..., bearing_sigma: _Optional[float] = ...) -> None: ...

class Place(_message.Message):
    __slots__ = ("keyframe_id", "session", "stamp_ns", "file", "score", "votes", "jeffrey", "inliers", "accepted", "reason", "T_map_cam", "view", "probability", "direction")
    KEYFRAME_ID_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    FILE_FIELD_NUMBER: _ClassVar[int]
    SCORE_FIELD_NUMBER: _ClassVar[int]
    VOTES_FIELD_NUMBER: _ClassVar[int]
    JEFFREY_FIELD_NUMBER: _ClassVar[int]
    INLIERS_FIELD_NUMBER: _ClassVar[int]
    ACCEPTED_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    T_MAP_CAM_FIELD_NUMBER: _ClassVar[int]
    VIEW_FIELD_NUMBER: _ClassVar[int]
    PROBABILITY_FIELD_NUMBER: _ClassVar[int]
    DIRECTION_FIELD_NUMBER: _ClassVar[int]
    keyframe_id: int
    session: int
    stamp_ns: int
    file: str
    score: float
    votes: float
    jeffrey: float
    inliers: int
    accepted: bool
    reason: str
    T_map_cam: Array
    view: float
    probability: float
    direction: Direction
    def __init__(self, keyframe_id: _Optional[int] = ..., session: _Optional[int] = ..., stamp_ns: _Optional[int] = ..., file: _Optional[str] = ..., score: _Optional[float] = ..., votes: _Optional[float] = ..., jeffrey: _Optional[float] = ..., inliers: _Optional[int] = ..., accepted: _Optional[bool] = ..., reason: _Optional[str] = ..., T_map_cam: _Optional[_Union[Array, _Mapping]] = ..., view: _Optional[float] = ..., probability: _Optional[float] = ..., direction: _Optional[_Union[Direction, _Mapping]] = ...) -> None: ...

class PlaceReply(_message.Message):
    __slots__ = ("schema_version", "places", "error_code", "error_message", "timings_ms", "verdict")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    PLACES_FIELD_NUMBER: _ClassVar[int]
    ERROR_CODE_FIELD_NUMBER: _ClassVar[int]
    ERROR_MESSAGE_FIELD_NUMBER: _ClassVar[int]
    TIMINGS_MS_FIELD_NUMBER: _ClassVar[int]
    VERDICT_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    places: _containers.RepeatedCompositeFieldContainer[Place]
    error_code: str
    error_message: str
    timings_ms: _containers.RepeatedCompositeFieldContainer[Stage]
    verdict: str
    def __init__(self, schema_version: _Optional[int] = ..., places: _Optional[_Iterable[_Union[Place, _Mapping]]] = ..., error_code: _Optional[str] = ..., error_message: _Optional[str] = ..., timings_ms: _Optional[_Iterable[_Union[Stage, _Mapping]]] = ..., verdict: _Optional[str] = ...) -> None: ...

class Empty(_message.Message):
    __slots__ = ("schema_version",)
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    def __init__(self, schema_version: _Optional[int] = ...) -> None: ...

class Forget(_message.Message):
    __slots__ = ("schema_version", "keyframe_ids")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    KEYFRAME_IDS_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    keyframe_ids: Array
    def __init__(self, schema_version: _Optional[int] = ..., keyframe_ids: _Optional[_Union[Array, _Mapping]] = ...) -> None: ...

class Done(_message.Message):
    __slots__ = ("schema_version", "node")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    NODE_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    node: str
    def __init__(self, schema_version: _Optional[int] = ..., node: _Optional[str] = ...) -> None: ...

class Counter(_message.Message):
    __slots__ = ("name", "count")
    NAME_FIELD_NUMBER: _ClassVar[int]
    COUNT_FIELD_NUMBER: _ClassVar[int]
    name: str
    count: int
    def __init__(self, name: _Optional[str] = ..., count: _Optional[int] = ...) -> None: ...

class Status(_message.Message):
    __slots__ = ("schema_version", "node", "pid", "rss_bytes", "peak_rss_bytes", "cpu_s", "counters", "stages_ms")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    NODE_FIELD_NUMBER: _ClassVar[int]
    PID_FIELD_NUMBER: _ClassVar[int]
    RSS_BYTES_FIELD_NUMBER: _ClassVar[int]
    PEAK_RSS_BYTES_FIELD_NUMBER: _ClassVar[int]
    CPU_S_FIELD_NUMBER: _ClassVar[int]
    COUNTERS_FIELD_NUMBER: _ClassVar[int]
    STAGES_MS_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    node: str
    pid: int
    rss_bytes: int
    peak_rss_bytes: int
    cpu_s: float
    counters: _containers.RepeatedCompositeFieldContainer[Counter]
    stages_ms: _containers.RepeatedCompositeFieldContainer[Stage]
    def __init__(self, schema_version: _Optional[int] = ..., node: _Optional[str] = ..., pid: _Optional[int] = ..., rss_bytes: _Optional[int] = ..., peak_rss_bytes: _Optional[int] = ..., cpu_s: _Optional[float] = ..., counters: _Optional[_Iterable[_Union[Counter, _Mapping]]] = ..., stages_ms: _Optional[_Iterable[_Union[Stage, _Mapping]]] = ...) -> None: ...
