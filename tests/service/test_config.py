from pathlib import Path

import pytest
import yaml

from seamark.service.config import ConfigError, SeamarkConfig, config_hash, dump_yaml, load_config


def test_order_of_the_layers(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    path.write_text("seed: 1\nservice: {frame_window: 5, record: false}\nfrontend: {max_corners: 100}\n")
    assert load_config() == SeamarkConfig()
    assert load_config(path).service.frame_window == 5
    environment = {"SEAMARK_SERVICE__FRAME_WINDOW": "6", "SEAMARK_SEED": "2", "HOME": "/", "SEAMARK_HOME": "x"}
    config = load_config(path, environment)
    assert (config.service.frame_window, config.seed, config.service.record) == (6, 2, False)
    config = load_config(path, environment, ["service.frame_window=7", "frontend.corner_detector=harris"])
    assert (config.service.frame_window, config.frontend.max_corners) == (7, 100)
    assert config.frontend.corner_detector == "harris"
    assert load_config(None, {}, ["frontend.min_corner_response=1e-5"]).frontend.min_corner_response == 1e-5


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["frontend.max_cornerz=3"], "-o: frontend.max_cornerz is not a known key; did you mean frontend.max_corners?"),
        (["frontent.max_corners=3"], "frontent is not a known key; did you mean frontend?"),
        (["service.frame_window=0"], "service.frame_window = 0"),
        (["service.frame_window=many"], "service.frame_window = 'many'"),
        (["service=3"], "service = 3"),
        (["service.frame_window.x=3"], "service.frame_window"),
        (["seed"], "section.key=value"),
        (["=3"], "section.key=value"),
        (["seed=[1"], "not a value in YAML"),
    ],
)
def test_bad_overrides(overrides: list[str], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config(None, {}, overrides)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_origin_of_the_bad_key(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    path.write_text("service: {frame_windo: 5}\n")
    with pytest.raises(ConfigError, match=r"c\.yaml: service\.frame_windo is not a known key; did you mean"):
        load_config(path)
    with pytest.raises(ConfigError, match=r"SEAMARK_VOCAB__WRDS: vocab\.wrds is not a known key"):
        load_config(None, {"SEAMARK_VOCAB__WRDS": "3"})


def test_bad_files(tmp_path: Path) -> None:
    for text, message in [("a: [", "not valid YAML"), ("words", "keys and values")]:
        (tmp_path / "c.yaml").write_text(text)
        with pytest.raises(ConfigError, match=message):
            load_config(tmp_path / "c.yaml")
    (tmp_path / "c.yaml").write_text("")
    assert load_config(tmp_path / "c.yaml") == SeamarkConfig()
    with pytest.raises(ConfigError, match=r"nowhere\.yaml"):
        load_config(tmp_path / "nowhere.yaml")


def test_dump_reads_back_and_the_hash_sees_every_change(tmp_path: Path) -> None:
    config = load_config(None, {}, ["seed=9", "service.record=false"])
    (tmp_path / "c.yaml").write_text(dump_yaml(config))
    assert load_config(tmp_path / "c.yaml") == config
    assert list(yaml.safe_load(dump_yaml(config))) == ["seed", "frontend", "vocab", "backend", "service"]
    assert config_hash(config) == config_hash(load_config(tmp_path / "c.yaml"))
    assert len(config_hash(config)) == 16
    assert config_hash(config) != config_hash(load_config(None, {}, ["seed=9"]))
