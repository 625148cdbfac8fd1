"""The real sequences that the front end is measured on: folder below DATA and mode."""

REAL = {
    "tum_fr1_rpy rgbd": ("tum_fr1_rpy", "rgbd"),
    "rgbd_hololens rgbd": ("rgbd_hololens", "rgbd"),
    "rgbd_hololens mono": ("rgbd_hololens", "mono"),
    "kitti06 stereo": ("kitti06_stereo_000-050", "stereo"),
    "kitti06 mono": ("kitti06_stereo_000-050", "mono"),
}
