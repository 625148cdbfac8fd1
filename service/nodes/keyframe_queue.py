"""Keyframes and their candidates, which come by different ways, until both are there."""

from collections.abc import Iterable
from concurrent.futures import Future
from dataclasses import dataclass

from seamark.frontend.types import Keyframe
from seamark.vocab.types import Candidates


@dataclass(frozen=True, eq=False)
class Arrived:
    """A keyframe whose turn it is.

    ``candidates`` is None where they will not come; ``mapped`` is to be done when the keyframe has been mapped.
    ``left``: it was stored in an earlier life, whose candidates nobody sends again.
    """

    keyframe: Keyframe
    candidates: Candidates | None
    mapped: "Future[None]"
    left: bool


class KeyframeQueue:
    """Keyframes that wait for their candidates, in the order of their numbers, and candidates that came before theirs.

    Candidates come in the order of the keyframes: those of an older one will never come once a newer one's are here
    (the vocabulary has refused that keyframe). Not locked.
    """

    def __init__(self) -> None:
        self._waiting: dict[int, Keyframe] = {}
        self._candidates: dict[int, tuple[Candidates, Future[None]]] = {}
        self._refused: set[int] = set()
        self._left: set[int] = set()

    def __contains__(self, keyframe_id: int) -> bool:
        return keyframe_id in self._waiting

    def restore(self, keyframes: Iterable[Keyframe]) -> None:
        """Take in keyframes that an earlier life had stored and not mapped."""
        for keyframe in keyframes:
            self._waiting[keyframe.id] = keyframe
            self._left.add(keyframe.id)

    def add(self, keyframe: Keyframe) -> None:
        """Let a keyframe wait."""
        self._waiting[keyframe.id] = keyframe

    def refuse(self, keyframe_id: int) -> None:
        """Let nobody wait for a keyframe that the disk has refused."""
        self._refused.add(keyframe_id)
        if keyframe_id in self._candidates:
            self._candidates.pop(keyframe_id)[1].set_result(None)

    def refused(self, keyframe_id: int) -> bool:
        """Return whether a keyframe has been refused."""
        return keyframe_id in self._refused

    def put(self, candidates: Candidates) -> "Future[None]":
        """Keep candidates for their keyframe; return what is done when that has been mapped."""
        mapped: Future[None] = Future()
        self._candidates[candidates.query_id] = candidates, mapped
        return mapped

    def everyone(self) -> list[int]:
        """Return the numbers of all that wait."""
        return list(self._waiting)

    def ready(self) -> list[int]:
        """Return the numbers of the keyframes that need not wait for their candidates any more."""
        newest = max(self._candidates, default=-1)
        return [number for number in self._waiting if number <= newest]

    def take(self, keyframe_id: int) -> Arrived:
        """Give out a waiting keyframe; candidates of older ones, which never came, are done with."""
        keyframe = self._waiting.pop(keyframe_id)
        for old in [number for number in self._candidates if number < keyframe_id]:
            self._candidates.pop(old)[1].set_result(None)
        candidates, mapped = self._candidates.pop(keyframe_id, (None, Future[None]()))
        return Arrived(keyframe, candidates, mapped, keyframe_id in self._left)
