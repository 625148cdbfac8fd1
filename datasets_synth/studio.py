"""Where a specification becomes frames: world, light, people and camera, frame by frame; runs in the worker only."""

import numpy as np
from numpy.typing import NDArray

from seamark.datasets_synth import lighting, optics, sensor
from seamark.datasets_synth.figures import whole_people
from seamark.datasets_synth.people import people_of
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
        self._people = people_of(specification, self._world.panels)
        self._renderer = Renderer(self._world, wide_rig, self._people.figures, meter=self._camera.automatic)
        self._exposure = optics.AutomaticExposure()
        self._metered = 0
        self._factor = 1.0

    def frame(self, index: int) -> CodedFrame:
        """Return frame ``index``, which must not be before the last one."""
        wanted, model = self._specification, self._model
        exposure = self._expose(index)
        self._set(index)
        smears = exposure.shutter_s > 0
        labels = wanted.labels > 0 or (smears and len(self._people.figures) > 0)
        view = self._renderer.render(self._poses[index], exposure=exposure.factor, labels=labels, right_depth=smears)
        left, right = self._photograph(view, index, exposure)
        rng = np.random.default_rng([wanted.motion_seed, index, 0x5E])
        left_file = sensor.code_picture(sensor.expose(left, model, rng, exposure.gain))
        right_file = b"" if right is None else sensor.code_picture(sensor.expose(right, model, rng, exposure.gain))
        depth_file = b""
        if wanted.mode is Mode.RGBD:
            depth = self._lens.depth(view.depth)
            depth_file = sensor.code_depth(sensor.measure_depth(depth, self._warp, model, rng, wanted.rig.cam0.fx))
        labels_file = b""
        if wanted.labels and view.labels is not None:
            seen = self._lens.labels(view.labels)
            labels_file = sensor.code_labels(whole_people(seen) if wanted.labels == 1 else seen)
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
        for number in range(len(self._people.figures)):
            self._renderer.place(number, self._people.poses(number, index))

    def _photograph(
        self, view: View, index: int, exposure: optics.Exposure
    ) -> tuple[optics.Colour, optics.Colour | None]:
        """Return both pictures after shutter, lens and vignetting."""

        def taken(picture: optics.Colour) -> optics.Colour:
            seen = self._lens.colour(picture)
            return seen if self._vignette is None else seen * self._vignette

        left, right = view.left, view.right
        if exposure.shutter_s > 0:
            frames = exposure.shutter_s * FPS
            left = self._blurred(left, view.depth, view.labels, self._poses, index, frames)
            rig = self._specification.rig
            if right is not None and view.right_depth is not None and rig.T_cam0_cam1 is not None:
                poses = self._poses @ rig.T_cam0_cam1
                right = self._blurred(right, view.right_depth, view.right_labels, poses, index, frames)
        return taken(left), None if right is None else taken(right)

    def _blurred(
        self,
        picture: optics.Colour,
        depth: optics.Depth,
        labels: NDArray[np.uint8] | None,
        T_world_cam: NDArray[np.float64],
        index: int,
        frames: float,
    ) -> optics.Colour:
        """Return what an eye sees while its shutter is open for so many ``frames``."""
        pair = _pair(T_world_cam, index)
        if pair is None:
            return picture
        now, later = pair
        T_later_now = se3.inverse(T_world_cam[later]) @ T_world_cam[now]
        motion = optics.image_motion(self._lens.wide, depth, _part_of(T_later_now, frames))
        if labels is None:
            return optics.blur(picture, motion)
        T_later_world, T_world_now = se3.inverse(T_world_cam[later]), T_world_cam[now]
        parts = {
            label: _part_of(T_later_world @ T @ T_world_now, frames)
            for label, T in self._people.displacements(now, later).items()
        }
        moving = optics.moving_motion(self._lens.wide, depth, labels, parts)
        return optics.blur(picture, motion) if moving is None else optics.blur_moving(picture, motion, *moving)


def _pair(T_world_cam: NDArray[np.float64], index: int) -> tuple[int, int] | None:
    """Return two frames next to each other, one of them ``index``, or None where the camera was carried away."""
    for now, later in ((index, index + 1), (index - 1, index)):
        if now < 0 or later >= len(T_world_cam):
            continue
        if np.linalg.norm(T_world_cam[later, :3, 3] - T_world_cam[now, :3, 3]) * FPS < TELEPORT_M_S:
            return now, later
    return None


def _part_of(T_later_now: se3.Matrix, frames: float) -> se3.Matrix:
    """Return the motion over so many frame periods."""
    turned = se3.exp_rotation(frames * se3.log_rotation(T_later_now[:3, :3]))
    return se3.make(turned, frames * T_later_now[:3, 3])
