"""What can go wrong in the vocabulary because of what it was given."""

from seamark import SeamarkError


class KernelsMissingError(SeamarkError):
    """An installation without the compiled kernels."""


class VocabularyFileError(SeamarkError):
    """A vocabulary file that is missing, damaged, or of a version this program does not read."""


class IndexFileError(SeamarkError):
    """A place index on disk that is missing, damaged, of another vocabulary, or of other settings."""


class TrainingError(SeamarkError):
    """Training data from which no vocabulary can be made."""


class ObservationError(SeamarkError):
    """A place observation whose arrays have the wrong shape or type."""


class DuplicatePlaceError(SeamarkError):
    """A place id that the index already holds."""


class UnknownPlaceError(SeamarkError):
    """A place id that the index does not hold."""
