"""What can be wrong with the back end's input and surroundings."""

from seamark import SeamarkError


class BackendInputError(SeamarkError):
    """A keyframe or loop handed to the back end is malformed or contradicts what it knows."""


class GraphFileError(BackendInputError):
    """A file is no pose graph, or one with impossible numbers."""


class SolverError(SeamarkError):
    """The solver could not be kept alive, or could not solve."""


class MapError(SeamarkError):
    """A map cannot be opened, read or written."""


class MapVersionError(MapError):
    """The file is no map of ours or of a version that this program does not know."""


class MapInUseError(MapError):
    """Another process has the map: one that writes it, or one that reads it as it is (``by_readers``)."""

    def __init__(self, message: str, by_readers: bool = False) -> None:
        super().__init__(message)
        self.by_readers = by_readers


class MapUnwritableError(MapError):
    """The disk takes no more: it is full, read-only or failing. What was written before is whole."""


class MapCorruptError(MapError):
    """What was read from a map is not what was written."""
