from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

_Block: TypeAlias = tuple[
    int,
    NDArray[np.uint32],
    NDArray[np.uint16],
    NDArray[np.uint8],
    NDArray[np.uint64] | None,
    NDArray[np.uint16] | None,
]

def levels() -> list[str]: ...
def top(scores: NDArray[np.float32], k: int) -> NDArray[np.int32]: ...
def mutual(rows: NDArray[np.uint8], columns: NDArray[np.uint8], level: str | None = None) -> NDArray[np.int32]: ...
def similarity(
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    to_x: NDArray[np.float32],
    to_y: NDArray[np.float32],
    log_scale: NDArray[np.float32],
    turn: NDArray[np.float32],
    tolerance: float,
    scale_step: float,
    most_turn: float,
) -> NDArray[np.uint8]: ...

class Quantiser:
    def __init__(
        self,
        words: NDArray[np.uint8],
        coarse: NDArray[np.uint8],
        offsets: NDArray[np.int64],
        level: str | None = None,
    ) -> None: ...
    @property
    def level(self) -> str: ...
    def assign(
        self, descriptors: NDArray[np.uint8], k: int = 1, beam: int = 1, reach: int = 0x7FFFFFFF
    ) -> tuple[NDArray[np.int32], NDArray[np.int32]]: ...

class Postings:
    def __init__(
        self,
        n_words: int,
        code_weights: NDArray[np.float32],
        code_shares: NDArray[np.float32],
        block_places: int = 65536,
        with_signatures: bool = False,
        with_geometry: bool = False,
        level: str | None = None,
    ) -> None: ...
    def add(
        self,
        words: NDArray[np.int32],
        codes: NDArray[np.uint8],
        mass: float,
        signatures: NDArray[np.uint64] | None = None,
        geometry: NDArray[np.uint16] | None = None,
    ) -> int: ...
    def remove(self, slot: int) -> bool: ...
    def compact(self) -> NDArray[np.int32]: ...
    def votes(
        self, words: NDArray[np.int32], weights: NDArray[np.float32], most: NDArray[np.float32], mass: float
    ) -> NDArray[np.float32]: ...
    def near_votes(
        self,
        words: NDArray[np.int32],
        weights: NDArray[np.float32],
        mass: float,
        signatures: NDArray[np.uint64],
        table: NDArray[np.float32],
        geometry: NDArray[np.uint16] | None = None,
    ) -> NDArray[np.float32]: ...
    def snapshot(self) -> tuple[list[_Block], NDArray[np.float32], NDArray[np.uint8]]: ...
    def attach(self, blocks: list[_Block], masses: NDArray[np.float32], live: NDArray[np.uint8]) -> None: ...
    @property
    def n_slots(self) -> int: ...
    @property
    def n_live(self) -> int: ...
    @property
    def n_bytes(self) -> int: ...
