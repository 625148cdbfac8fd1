"""Where a specification becomes frames: world, light, people and camera, frame by frame; runs in the worker only."""

import numpy as np
from numpy.typing import NDArray

from seamark.datasets_synth import lighting, movers, optics, sensor
from seamark.datasets_synth.panels import Panel
from seamark.datasets_synth.renderer import Renderer, View
from seamark.datasets_synth.sensor import CodedFrame
from seamark.datasets_synth.specification import FPS, Specification
from seamark.frontend import se3
from seamark.frontend.camera import Rig
from seamark.frontend.types import Mode

TELEPORT_M_S = 40.0  # faster than that nothing moves: it was carried, and nothing is blurred


class Studio:
    """Makes frame after frame; ask for them in ascending order."""

    def __init__(self, specification: Specification) -> None:
        self._specification = specification
        self._poses = specification.poses()
        self._model = sensor.MODELS[specification.sensor]
        self._camera = optics.MODELS[specification.camera]
        rig = specification.rig
        self._warp = self._model.distortion_field(rig.cam0.height, rig.cam0.width, specification.seed)
        self._lens = optics.Lens(rig.cam0)
        self._vignette = optics.vignette(rig.cam0, self._camera.vignetting)
        wide = self._lens.wide
        wide_rig = Rig(wide, None if rig.cam1 is None else wide, rig.T_cam0_cam1, rig.depth_factor)
        self._world = specification.build()
        people, self._tracks = _people(specification, self._poses)
        self._renderer = Renderer(self._world, wide_rig, people, meter=self._camera.automatic)
        self._exposure = optics.AutomaticExposure()
        self._metered = 0
        self._factor = 1.0

    def frame(self, index: int) -> CodedFrame:
        """Return frame ``index``, which must not be before the last one."""
        wanted, model = self._specification, self._model
        exposure = self._expose(index)
        self._set(index)
        view = self._renderer.render(self._poses[index], exposure=exposure.factor, labels=wanted.labels > 0)
        left, right = self._photograph(view, index, exposure)
        rng = np.random.default_rng([wanted.motion_seed, index, 0x5E])
        left_file = sensor.code_picture(sensor.expose(left, model, rng, exposure.gain))
        right_file = b"" if right is None else sensor.code_picture(sensor.expose(right, model, rng, exposure.gain))
        depth_file = b""
        if wanted.mode is Mode.RGBD:
            depth = self._lens.depth(view.depth)
            depth_file = sensor.code_depth(sensor.measure_depth(depth, self._warp, model, rng))
        labels_file = b"" if view.labels is None else sensor.code_labels(self._lens.labels(view.labels))
        return CodedFrame(index, left_file, right_file, depth_file, labels_file)

    def _expose(self, index: int) -> optics.Exposure:
        """Return the exposure of a frame: metered on all frames until then, so that any share of workers agrees."""
        if not self._camera.automatic:
            return optics.Exposure()
        while self._metered <= index:
            self._set(self._metered)
            self._factor = self._exposure.follow(self._renderer.meter(self._poses[self._metered]))
            self._metered += 1
        return optics.split_exposure(self._factor, self._camera)

    def _set(self, index: int) -> None:
        """Bring light and people to where they are at a frame."""
        wanted = self._specification
        share = index / max(1, wanted.frames - 1)
        self._renderer.illuminate(lighting.illumination(wanted.condition, self._world.sun is not None, share))
        for number, track in enumerate(self._tracks):
            place = track.position[index] if track.present[index] else None
            self._renderer.place(number, place, float(track.yaw[index]))

    def _photograph(
        self, view: View, index: int, exposure: optics.Exposure
    ) -> tuple[optics.Colour, optics.Colour | None]:
        """Return both pictures after shutter, lens and vignetting; both eyes are blurred by the motion in the left."""
        motion = None
        if exposure.shutter_s > 0:
            T_later_now = _motion(self._poses, index, exposure.shutter_s * FPS)
            if T_later_now is not None:
                motion = optics.image_motion(self._lens.wide, view.depth, T_later_now)

        def taken(picture: optics.Colour) -> optics.Colour:
            seen = self._lens.colour(picture if motion is None else optics.blur(picture, motion))
            return seen if self._vignette is None else seen * self._vignette

        return taken(view.left), None if view.right is None else taken(view.right)


def _people(specification: Specification, poses: NDArray[np.float64]) -> tuple[list[list[Panel]], list[movers.Track]]:
    """Return the people and their tracks, drawn from the seed of the motion."""
    people, tracks = [], []
    clearance_m = specification.route.clearance_m
    for number in range(specification.movers):
        rng = np.random.default_rng([specification.motion_seed, number, 0x9E0])
        people.append(movers.person(rng))
        tracks.append(movers.track(poses, FPS, clearance_m, rng))
    return people, tracks


def _motion(poses: NDArray[np.float64], index: int, frames: float) -> se3.Matrix | None:
    """Return T_later_now over so many frame periods, or None where the camera was carried away."""
    for now, later in ((index, index + 1), (index - 1, index)):
        if now < 0 or later >= len(poses):
            continue
        T_later_now = se3.inverse(poses[later]) @ poses[now]
        if np.linalg.norm(T_later_now[:3, 3]) * FPS < TELEPORT_M_S:
            turned = se3.exp_rotation(frames * se3.log_rotation(T_later_now[:3, :3]))
            return se3.make(turned, frames * T_later_now[:3, 3])
    return None
