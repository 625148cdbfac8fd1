"""The map of a service: opened as far as the disk lets it, and looked at whether it fits."""

import logging

from seamark import __version__
from seamark.backend.errors import MapError, MapUnwritableError
from seamark.backend.map_store import MapStore
from seamark.service.config import config_hash
from seamark.service.nodes.settings import NodeSettings
from seamark.vocab.vocabulary import Vocabulary

logger = logging.getLogger(__name__)

VOCABULARY = "vocabulary"  # in the map's meta: the hash of the one that its places were last quantised with


def open_map(settings: NodeSettings) -> MapStore | None:
    """Return the map, None where the settings name none; raises MapError for one that another mode has made.

    A patient service takes one that cannot be written as it is.
    """
    if settings.map_path is None:
        return None
    store = _opened(settings)
    try:
        _sign(store, settings)
    except BaseException:
        store.close()
        raise
    return store


def _opened(settings: NodeSettings) -> MapStore:
    assert settings.map_path is not None
    if settings.localise_only:
        return MapStore(settings.map_path, read_only=True)
    try:
        return MapStore(settings.map_path)
    except MapUnwritableError:
        if not settings.patient:
            raise
        return MapStore(settings.map_path, read_only=True)


def _sign(store: MapStore, settings: NodeSettings) -> None:
    """Write into a new map what made it; refuse one that another mode has made; say when the words are others.

    The map keeps descriptors and no words: with another vocabulary all its places are quantised anew, never mixed.
    """
    meta = store.meta()
    if meta.get("mode", settings.mode) != settings.mode:
        raise MapError(f"the map {store.path} was made in mode {meta['mode']} and cannot go on in {settings.mode}")
    path = settings.vocabulary
    words = (Vocabulary.default() if path is None else Vocabulary.load(path)).hash
    before = meta.get(VOCABULARY)
    if before is not None and before != words:
        names = before[:16], words[:16]
        logger.warning("%s was quantised with vocabulary %s; its places are with %s now", store.path, *names)
    facts = {} if before == words else {VOCABULARY: words}
    if "mode" not in meta:
        facts |= {"mode": str(settings.mode), "seamark": __version__, "config_hash": config_hash(settings.config)}
    if facts and not store.file.read_only:
        try:
            store.set_meta(facts)
        except MapUnwritableError:
            if not settings.patient:
                raise
