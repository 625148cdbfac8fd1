"""`seamark places match`: the table that other programs read, on folders with everything wrong that folders have."""

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from seamark.service.config import SeamarkConfig
from seamark.service.output import OutputError
from seamark.service.places_match import COLUMNS, MatchOptions, match_folders
from seamark.service.sources.base import SourceError

PLACES = 6
CONFIG = SeamarkConfig()


def scene(seed: int) -> NDArray[np.uint8]:
    """A wall of random boxes and letters, 420 x 260, of which images are cut."""
    rng = np.random.default_rng(seed)
    canvas = np.full((260, 420, 3), rng.integers(60, 200, 3), np.uint8)
    for _ in range(45):
        x, y, w, h = rng.integers(0, 400), rng.integers(0, 240), rng.integers(5, 70), rng.integers(5, 70)
        cv2.rectangle(canvas, (int(x), int(y)), (int(x + w), int(y + h)), rng.integers(0, 256, 3).tolist(), -1)
        letter = chr(int(rng.integers(65, 91)))
        cv2.putText(
            canvas, letter, (int(y), int(x) // 2), 0, float(rng.uniform(0.4, 1.2)), rng.integers(0, 256, 3).tolist(), 2
        )
    return canvas


def view_of(seed: int, offset: int) -> NDArray[np.uint8]:
    noise = np.random.default_rng([seed, offset + 50]).normal(0, 3, (240, 360, 3))
    return np.clip(scene(seed)[10:250, 20 + offset : 380 + offset] + noise, 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    root = tmp_path_factory.mktemp("places")
    database, queries = root / "known places", root / "queries"
    database.mkdir()
    queries.mkdir()
    for place in range(PLACES):
        cv2.imwrite(str(database / f"place {place}.png"), view_of(place, 0))
    (database / "notes.txt").write_text("not an image")
    (database / "broken, in two.png").write_bytes(b"\x89PNG\r\n\x1a\n and no more")
    cv2.imwrite(str(queries / "q1, from the left.jpg"), view_of(1, 15))
    cv2.imwrite(str(queries / "q2 grey.png"), cv2.cvtColor(view_of(2, -12), cv2.COLOR_BGR2GRAY))
    cv2.imwrite(str(queries / "q3 deep.png"), view_of(3, 8).astype(np.uint16) * 257)
    cv2.imwrite(str(queries / "q4 half the size.png"), cv2.resize(view_of(4, 10), None, fx=0.5, fy=0.5))
    cv2.imwrite(str(queries / "q5 flat.png"), np.full((50, 80), 128, np.uint8))
    cv2.imwrite(str(queries / "q6 elsewhere.png"), view_of(50, 0))
    whole = cv2.imencode(".jpg", view_of(0, 5))[1].tobytes()
    (queries / "q7 truncated.jpg").write_bytes(whole[: len(whole) // 2])
    return database, queries


def run(
    folders: tuple[Path, Path], out: Path, *, workers: int = 1, **options: object
) -> tuple[list[dict[str, str]], list[str]]:
    warnings: list[str] = []
    wanted = MatchOptions(folders[0], folders[1], out, **options)  # type: ignore[arg-type]
    summary = match_folders(wanted, CONFIG, workers, warnings.append)
    with out.open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert summary.rows == len(rows)
    assert sum(summary.verdicts.values()) == summary.query_images
    return rows, warnings


def test_the_table_has_top_rows_for_every_query_whatever_it_is(folders: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "new folder" / "matches.csv"
    rows, warnings = run(folders, out, top=4)
    assert out.read_text(encoding="utf-8").splitlines()[0] == "query,rank,match,score,votes,jeffrey,inliers,accepted"
    assert ",".join(COLUMNS) == "query,rank,match,score,votes,jeffrey,inliers,accepted"
    names = sorted(path.name for path in folders[1].iterdir())
    assert [row["query"] for row in rows] == [name for name in names for _ in range(4)]
    assert [row["rank"] for row in rows] == ["1", "2", "3", "4"] * len(names)
    known = {path.name for path in folders[0].iterdir()} - {"notes.txt"}
    for start in range(0, len(rows), 4):
        part = rows[start : start + 4]
        assert len({row["match"] for row in part}) == 4 and {row["match"] for row in part} <= known
        scores = [float(row["score"]) for row in part]
        assert scores == sorted(scores, reverse=True) and np.isfinite(scores).all()
        assert [row["accepted"] for row in part[1:]] == ["0"] * 3 and part[0]["accepted"] in ("0", "1")
        for row in part:
            assert 0 <= float(row["votes"]) <= 1 and 0 <= float(row["jeffrey"]) <= 1.3863 and int(row["inliers"]) >= 0
    assert len(warnings) == 2 and "broken, in two.png" in warnings[0] and "q7 truncated.jpg" in warnings[1]


def test_views_from_elsewhere_find_their_place(folders: tuple[Path, Path], tmp_path: Path) -> None:
    rows, _ = run(folders, tmp_path / "m.csv", top=1)
    best = {row["query"].split()[0].rstrip(","): row for row in rows}
    for number in (1, 2, 3, 4):
        assert best[f"q{number}"]["match"] == f"place {number}.png"
        assert 12 <= int(best[f"q{number}"]["inliers"]) <= 500
        assert best[f"q{number}"]["accepted"] == "1"
    assert [best[f"q{number}"]["accepted"] for number in (1, 2, 3, 4)].count("1") >= 3
    for number in (5, 6, 7):
        assert best[f"q{number}"]["accepted"] == "0"
        assert int(best[f"q{number}"]["inliers"]) < 8


def test_the_order_of_files_never_matters_nor_another_query_unless_together(
    folders: tuple[Path, Path], tmp_path: Path
) -> None:
    """Test: the same queries under names in reverse order, and a single one. Expected: the same rows for each."""
    names = sorted(path.name for path in folders[1].iterdir())
    reverse, single = tmp_path / "reverse", tmp_path / "single"
    for folder in (reverse, single):
        folder.mkdir()
    renamed = {name: f"{number}{Path(name).suffix}" for number, name in enumerate(reversed(names))}
    for name, other in renamed.items():
        (reverse / other).write_bytes((folders[1] / name).read_bytes())
    (single / names[0]).write_bytes((folders[1] / names[0]).read_bytes())

    def answers(queries: Path, *, together: bool) -> dict[str, list[tuple[str, str]]]:
        rows, _ = run((folders[0], queries), tmp_path / "m.csv", together=together)
        found: dict[str, list[tuple[str, str]]] = {}
        for row in rows:
            found.setdefault(row["query"], []).append((row["match"], row["score"]))
        return found

    common = answers(folders[1], together=True)
    turned = answers(reverse, together=True)
    assert {name: turned[other] for name, other in renamed.items()} == common
    assert answers(single, together=False)[names[0]] == answers(folders[1], together=False)[names[0]]
    assert answers(single, together=True)[names[0]] != common[names[0]]


def test_a_small_database_gives_all_it_has(folders: tuple[Path, Path], tmp_path: Path) -> None:
    rows, _ = run(folders, tmp_path / "m.csv", top=20)
    queries = len(list(folders[1].iterdir()))
    assert len(rows) == (PLACES + 1) * queries  # the broken image of the database is one of its images
    last = [row["match"] for row in rows if row["rank"] == str(PLACES + 1)]
    assert last.count("broken, in two.png") >= queries - 2  # an empty query cannot tell


def test_same_input_same_bytes_with_any_number_of_threads(folders: tuple[Path, Path], tmp_path: Path) -> None:
    for in_order in (False, True):
        outs = [tmp_path / f"{in_order} {number}.csv" for number in range(3)]
        for out, workers in zip(outs, (1, 3, 1), strict=True):
            run(folders, out, workers=workers, in_order=in_order)
        assert outs[0].read_bytes() == outs[1].read_bytes() == outs[2].read_bytes()


def test_says_in_one_sentence_what_is_wrong(folders: tuple[Path, Path], tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(SourceError, match="empty holds no images"):
        run((folders[0], empty), tmp_path / "m.csv")
    with pytest.raises(SourceError, match="nowhere"):
        run((tmp_path / "nowhere", folders[1]), tmp_path / "m.csv")
    with pytest.raises(OutputError, match="cannot be written"):
        run(folders, tmp_path / "m.csv" / "deeper.csv" if (tmp_path / "m.csv").write_text("x") else tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty", "m.csv"]
