"""What can be wrong with the back end's input and surroundings."""

from seamark import SeamarkError


class BackendInputError(SeamarkError):
    """A keyframe or loop handed to the back end is malformed or contradicts what it knows."""


class SolverError(SeamarkError):
    """The solver could not be kept alive, or could not solve."""


class MapError(SeamarkError):
    """A map cannot be opened, read or written."""


class MapVersionError(MapError):
    """The file is no map of ours or of a version that this program does not know."""


class MapCorruptError(MapError):
    """What was read from a map is not what was written."""
