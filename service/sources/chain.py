"""Several sources one after another."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from seamark.frontend.camera import Rig
from seamark.frontend.types import Frame, Mode
from seamark.service.sources.base import Source, SourceError, Unreadable
from seamark.service.types import Trajectory


@dataclass(frozen=True, eq=False)
class ChainSource:
    """The frames of all parts, with indices that run on and file names that begin with the part's name.

    The stamps of a part stay as they are when they come after those before it, else they are shifted to begin one
    period later than the last. Ground truth exists when every part has it: each part's is cut to the time of its
    frames and shifted with them; it is taken as given, so all parts must share one world frame.
    """

    parts: tuple[Source, ...]
    prefixes: tuple[str, ...]
    mode: Mode
    modes: tuple[Mode, ...]
    rig: Rig | None
    ground_truth: Trajectory | None

    @property
    def name(self) -> str:
        """Return the names of all parts."""
        return " + ".join(part.name for part in self.parts)

    @property
    def n_frames(self) -> int | None:
        """Return the number of all frames, None when one part does not know its own."""
        counts = [part.n_frames for part in self.parts]
        known = [count for count in counts if count is not None]
        return sum(known) if len(known) == len(counts) else None

    @property
    def stamps_ns(self) -> NDArray[np.int64] | None:
        """Return the shifted stamps of all frames, None when one part does not know its own."""
        stamps = _known_stamps(self.parts)
        return None if stamps is None else np.concatenate(stamps)

    @property
    def period_ns(self) -> int:
        """Return the usual time between two frames of the first part."""
        return self.parts[0].period_ns

    def frames(self) -> Iterator[Frame | Unreadable]:
        """Yield all frames in order."""
        index = 0
        last: int | None = None
        for k, (part, prefix) in enumerate(zip(self.parts, self.prefixes, strict=True)):
            shift: int | None = None
            for item in part.frames():
                if shift is None:
                    shift = _shift(item.stamp_ns, last, self.parts[k - 1].period_ns)
                stamp = item.stamp_ns + shift
                last = stamp if last is None else max(last, stamp)
                yield replace(item, index=index, stamp_ns=stamp, file=f"{prefix}/{item.file}")
                index += 1


def chain(parts: Sequence[Source]) -> ChainSource:
    """Join sources of one mode; raises SourceError when their modes or, outside mode places, calibrations differ."""
    mode = parts[0].mode
    if any(part.mode is not mode for part in parts):
        raise SourceError(f"the sources run in different modes: {', '.join(f'{p.name} {p.mode}' for p in parts)}")
    rig = parts[0].rig
    for part in parts[1:]:
        if not _same(rig, part.rig):
            if mode is not Mode.PLACES:
                raise SourceError(f"{parts[0].name} and {part.name} have different calibrations; run them one by one")
            rig = None
    modes = tuple(one for one in parts[0].modes if all(one in part.modes for part in parts))
    return ChainSource(tuple(parts), _prefixes(parts), mode, modes, rig, _joined_truth(parts))


def _shift(first: int, last: int | None, period_ns: int) -> int:
    return 0 if last is None or first > last else last + period_ns - first


def _known_stamps(parts: Sequence[Source]) -> list[NDArray[np.int64]] | None:
    out: list[NDArray[np.int64]] = []
    last: int | None = None
    for k, part in enumerate(parts):
        stamps = part.stamps_ns
        if stamps is None or len(stamps) == 0:
            return None
        shifted = stamps + _shift(int(stamps[0]), last, parts[k - 1].period_ns)
        last = int(shifted.max()) if last is None else max(last, int(shifted.max()))
        out.append(shifted)
    return out


def _joined_truth(parts: Sequence[Source]) -> Trajectory | None:
    shifted = _known_stamps(parts)
    if shifted is None:
        return None
    stamps, poses = [], []
    for part, now in zip(parts, shifted, strict=True):
        truth, before = part.ground_truth, part.stamps_ns
        if truth is None or before is None:
            return None
        margin = part.period_ns // 2
        inside = (truth.stamps_ns >= before.min() - margin) & (truth.stamps_ns <= before.max() + margin)
        stamps.append(truth.stamps_ns[inside] + (now[0] - before[0]))
        poses.append(truth.T_world_cam[inside])
    unique, first = np.unique(np.concatenate(stamps), return_index=True)
    return Trajectory(unique, np.concatenate(poses)[first])


def _prefixes(parts: Sequence[Source]) -> tuple[str, ...]:
    names = [part.name for part in parts]
    if len(set(names)) == len(names):
        return tuple(names)
    return tuple(f"{k}_{name}" for k, name in enumerate(names))


def _same(a: Rig | None, b: Rig | None) -> bool:
    if a is None or b is None:
        return a is b
    if a.T_cam0_cam1 is None or b.T_cam0_cam1 is None:
        right = a.T_cam0_cam1 is b.T_cam0_cam1
    else:
        right = np.array_equal(a.T_cam0_cam1, b.T_cam0_cam1)
    return a.cam0 == b.cam0 and a.cam1 == b.cam1 and a.depth_factor == b.depth_factor and right
