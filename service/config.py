"""The whole configuration: defaults, then a YAML file, then the environment, then the command line."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from seamark import SeamarkError
from seamark.backend.config import BackendConfig
from seamark.frontend.config import FrontendConfig
from seamark.frontend.types import Mode
from seamark.service.validation import dotted, sentence
from seamark.vocab.config import VocabConfig

ENVIRONMENT_PREFIX = "SEAMARK_"
ENVIRONMENT_SEPARATOR = "__"


class ConfigError(SeamarkError):
    """A configuration has an unknown key or a bad value."""


class ServiceConfig(BaseModel):
    """How nodes, results and recordings behave."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    frame_window: int = Field(4, ge=1, le=64, description="frames sent and not yet acknowledged in an offline run")
    record: bool = Field(True, description="whether a run leaves a rerun recording")
    recording_image_px: int = Field(640, ge=64, le=4096, description="longer side of the images in the recording")
    recording_jpeg_quality: int = Field(80, ge=10, le=100)


class SeamarkConfig(BaseModel):
    """The configuration of all rooms; ``seed`` feeds every random choice."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    seed: int = Field(0, ge=0, lt=2**31)
    frontend: FrontendConfig = Field(default_factory=lambda: FrontendConfig.model_validate({}))
    vocab: VocabConfig = Field(default_factory=lambda: VocabConfig.model_validate({}))
    backend: BackendConfig = Field(default_factory=lambda: BackendConfig.model_validate({}))
    service: ServiceConfig = Field(default_factory=lambda: ServiceConfig.model_validate({}))


def load_config(
    path: Path | None = None, environment: Mapping[str, str] | None = None, overrides: Sequence[str] = ()
) -> SeamarkConfig:
    """Return defaults < YAML at ``path`` < ``SEAMARK_SECTION__KEY`` < ``section.key=value``; raises ConfigError.

    Of the environment only names with a double underscore, and SEAMARK_SEED, are read. Values there and in
    ``overrides`` are written as in YAML. The error says where the bad key came from.
    """
    layers = [(str(path), _from_yaml(path))] if path is not None else []
    layers += _from_environment(environment or {})
    layers += [("-o", _from_override(text)) for text in overrides]
    content: dict[str, Any] = {}
    origins: dict[str, str] = {}
    for origin, layer in layers:
        _merge(content, layer, origin, origins, ())
    try:
        return SeamarkConfig.model_validate(content)
    except ValidationError as error:
        location = dotted(error.errors()[0]["loc"])
        origin = next((o for key, o in origins.items() if f"{location}.".startswith(f"{key}.")), "")
        # An unknown section has no origin of its own, but what lies in it has.
        origin = origin or next((o for key, o in origins.items() if key.startswith(f"{location}.")), "")
        raise ConfigError(f"{origin}: {sentence(error, SeamarkConfig)}".removeprefix(": ")) from error


def for_mode(config: SeamarkConfig, mode: Mode) -> SeamarkConfig:
    """Return the configuration as the mode needs it: without motion, the recent past is excluded by count."""
    if mode is not Mode.PLACES:
        return config
    vocab = config.vocab.model_copy(
        update={"exclude_recent_s": 0.0, "exclude_recent_count": config.vocab.exclude_recent_count_places}
    )
    return config.model_copy(update={"vocab": vocab})


def dump_yaml(config: SeamarkConfig) -> str:
    """Return the whole configuration as YAML that load_config reads back."""
    return yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False)


def config_hash(config: SeamarkConfig) -> str:
    """Return 16 hexadecimal digits that change with any value of the configuration."""
    canonical = json.dumps(config.model_dump(mode="json"), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()[:16]


def _from_yaml(path: Path) -> dict[str, Any]:
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} cannot be read as a configuration: {error}") from error
    except yaml.YAMLError as error:
        raise ConfigError(f"{path} is not valid YAML: {' '.join(str(error).split())}") from error
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise ConfigError(f"{path} must hold keys and values")
    return content


def _from_environment(environment: Mapping[str, str]) -> list[tuple[str, dict[str, Any]]]:
    layers = []
    for name in sorted(environment):
        key = name.removeprefix(ENVIRONMENT_PREFIX)
        if key == name or not (ENVIRONMENT_SEPARATOR in key or key == "SEED"):
            continue
        parts = key.lower().split(ENVIRONMENT_SEPARATOR)
        layers.append((name, _nested(parts, _value(name, environment[name]))))
    return layers


def _from_override(text: str) -> dict[str, Any]:
    key, equals, value = text.partition("=")
    parts = key.strip().split(".")
    if not equals or not all(parts):
        raise ConfigError(f"-o {text!r} must be written as section.key=value")
    return _nested(parts, _value(f"-o {key.strip()}", value))


def _value(name: str, text: str) -> Any:
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigError(f"{name}: {text!r} is not a value in YAML") from error


def _nested(parts: Sequence[str], value: Any) -> dict[str, Any]:
    for part in reversed(parts):
        value = {part: value}
    return dict(value)


def _merge(
    into: dict[str, Any], layer: dict[str, Any], origin: str, origins: dict[str, str], location: tuple[str, ...]
) -> None:
    for key, value in layer.items():
        here = (*location, str(key))
        if isinstance(value, dict) and isinstance(into.setdefault(str(key), {}), dict):
            _merge(into[str(key)], value, origin, origins, here)
        elif isinstance(value, dict):
            continue  # what was a section has been given a value, which will be refused
        else:
            into[str(key)] = value
            origins[dotted(here)] = origin
