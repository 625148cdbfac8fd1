"""How long the stages of a step take."""

from collections.abc import Callable


class Stopwatch:
    """Collects the milliseconds of named stages; times are reported, never decided upon."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock, self._last = clock, clock()
        self.stages_ms: dict[str, float] = {}

    def lap(self, stage: str) -> None:
        """Book the time since the last lap."""
        now = self._clock()
        self.stages_ms[stage] = self.stages_ms.get(stage, 0.0) + 1e3 * (now - self._last)
        self._last = now
