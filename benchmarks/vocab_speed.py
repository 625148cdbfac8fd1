"""Speed and memory of the vocabulary: words, votes, signatures, the file, training. One thread.

    .venv/bin/python benchmarks/vocab_speed.py [--images DIR] [--places 100000] [--plot docs/images/vocab_speed.png]

Descriptors to quantise are those of the photographs in DIR, else of generated images.

Places are synthetic: 1000 words each out of 100,000, drawn with probabilities (rank + 10)^-0.55, which is how 65,536
words spread over 200 photographs of one path. A query visits 27 postings per place, as among photographs of one
neighbourhood (unrelated images: 17). Milliseconds are wall time; each query is asked in several rounds, with 39 others
in between so that its lists are cold, and its best round counts, because the machine is shared; p50 and p99 are over
the queries.
"""

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from seamark.datasets_synth.imagery import training_images
from seamark.frontend.features import extract_features
from seamark.vocab import index_file
from seamark.vocab.clustering import two_level_k_means
from seamark.vocab.inverted_index import InvertedIndex, best
from seamark.vocab.kernels import native
from seamark.vocab.training import BEAM, REACH
from seamark.vocab.vocabulary import Vocabulary

N_WORDS, PER_PLACE, QUERIES, ROUNDS, TOP = 100_000, 1000, 40, 6, 20
SIZES = (1_000, 3_000, 10_000, 30_000, 100_000)
TABLE = np.where(np.arange(65) <= 24, np.exp(-((np.arange(65) / 16) ** 2)), 0).astype(np.float32)
Place = tuple[NDArray[np.int32], NDArray[np.uint64]]


class Source:
    """Places whose words are as unevenly spread as real ones."""

    def __init__(self, seed: int) -> None:
        self.random = np.random.default_rng(seed)
        share = (np.arange(N_WORDS) + 10.0) ** -0.55
        share /= share.sum()
        self.cumulative = np.cumsum(share)
        self.word = self.random.permutation(N_WORDS).astype(np.int32)
        seen = 1 - (1 - share) ** PER_PLACE
        self.idf = np.empty(N_WORDS, np.float32)
        self.idf[self.word] = -np.log(seen)
        self.common = float((seen**2).sum())

    def place(self) -> Place:
        words = self.word[np.searchsorted(self.cumulative, self.random.random(PER_PLACE))]
        return words, self.random.integers(0, 2**64, PER_PLACE, dtype=np.uint64)


def best_rounds(n: int, act: Callable[[int], object], rounds: int = ROUNDS) -> NDArray[np.float64]:
    """Return for each of n inputs the milliseconds of its best round."""
    least = np.full(n, np.inf)
    for _ in range(rounds):
        for i in range(n):
            start = time.perf_counter()
            act(i)
            least[i] = min(least[i], time.perf_counter() - start)
    return 1000 * least


def real_descriptors(images: Path | None) -> NDArray[np.uint8]:
    """Return those of twenty images, a thousand of each."""
    if images is None:
        pictures = list(training_images(777, 20))
    else:
        paths = sorted(images.glob("*.jpg"))
        pictures = [cv2.imread(str(path)) for path in paths[:: len(paths) // 20][:20]]
    return np.concatenate([extract_features(picture, 1000).descriptors for picture in pictures])


def quantising(images: Path | None) -> None:
    """Print the time of a thousand descriptors for each level, and how often the nearest word is found."""
    random = np.random.default_rng(1)
    shipped = Vocabulary.default()
    assert shipped.cells is not None
    descriptors = random.permutation(real_descriptors(images))
    n = len(descriptors) // 1000
    near = shipped.words[random.integers(0, shipped.n_words, 400_000)] + random.normal(0, 14, (400_000, 128))
    more = np.clip(near, 0, 255).astype(np.uint8)
    words, centres, offsets = two_level_k_means(more, N_WORDS, 391, 1, 4, lambda _done: None)
    cells = shipped.cells
    print("\n| 1000 descriptors | level | one cell ms | default search ms | exact search ms | nearest word found |")
    print("|---|---|---|---|---|---|")
    for name, w, c, o in (
        ("65,536 words (shipped)", shipped.words, cells.centres, cells.offsets),
        ("100,000 words", words, centres, offsets),
    ):
        for level in native.levels():
            tree = native.Quantiser(w, c, o, level)
            flat = native.Quantiser(w, c[:0], np.array([0, len(w)]), level)
            parts = [descriptors[1000 * i : 1000 * i + 1000] for i in range(n)]
            rounds = 1 if level == "baseline" else 12
            one = best_rounds(n, lambda i, t=tree, p=parts: t.assign(p[i], 1, 1), rounds)
            default = best_rounds(n, lambda i, t=tree, p=parts: t.assign(p[i], 1, BEAM, REACH), rounds)
            exact = best_rounds(2, lambda i, t=flat, p=parts: t.assign(p[i]), rounds)
            right = np.mean(tree.assign(descriptors, 1, BEAM, REACH)[0] == flat.assign(descriptors)[0])
            figures = " | ".join(f"{np.median(values):.2f}" for values in (one, default, exact))
            print(f"| {name} | {level} | {figures} | {100 * right:.1f} % |", flush=True)


def training() -> None:
    """Print the CPU time of a million descriptors to 65,536 words."""
    random = np.random.default_rng(2)
    words = Vocabulary.default().words
    descriptors = words[random.integers(0, len(words), 1_000_000)]
    descriptors ^= random.integers(0, 16, descriptors.shape, dtype=np.uint8)
    start = time.process_time()
    two_level_k_means(descriptors, 65_536, 256, 1, 8, lambda _done: None)
    print(f"\ntraining: 1M descriptors to 65,536 words in {time.process_time() - start:.1f} CPU s")


def voting(source: Source, most: int, signed: bool, folder: Path) -> list[tuple[int, float, float]]:
    """Grow one index and print a row at each size; return (places, p50, p99) of the votes that count."""
    index = InvertedIndex(source.idf, with_signatures=signed)
    queries = [source.place() for _ in range(QUERIES)]
    spent, rows = 0.0, []

    def ask(i: int) -> object:
        words, signatures = queries[i]
        return best(index.near_votes(words, signatures, TABLE) if signed else index.votes(words), TOP)

    for size in (size for size in SIZES if size <= most):
        added = size - index.n_slots
        for _ in range(added):
            words, signatures = source.place()
            start = time.perf_counter()
            index.add(words, *((signatures,) if signed else ()))
            spent += time.perf_counter() - start
        times = best_rounds(QUERIES, ask)
        rows.append((size, float(np.percentile(times, 50)), float(np.percentile(times, 99))))
        kind = "signatures" if signed else "votes"
        per_place = sum(len(block[2]) for block in index.snapshot()[0]) / size
        packed = sum(array.nbytes for block in index.snapshot()[0] for array in block[2:] if array is not None)
        print(
            f"| {kind} | {size:,} | {rows[-1][1]:.2f} | {rows[-1][2]:.2f} | {1000 * spent / size:.3f} | "
            f"{packed / size / per_place:.2f} | {index.n_bytes / 2**20:.0f} |",
            flush=True,
        )
    disk(index, source, signed, folder, queries[0])
    return rows


def disk(index: InvertedIndex, source: Source, signed: bool, folder: Path, query: Place) -> None:
    """Print what saving, opening, verifying, the first query, removing and compacting cost."""
    path = folder / "speed.places"

    def timed(act: Callable[[], object]) -> float:
        start = time.perf_counter()
        act()
        return 1000 * (time.perf_counter() - start)

    saved = timed(lambda: index_file.save(path, "speed", index, index.snapshot(), {}, {}))
    opened: list[InvertedIndex] = []
    opening = min(timed(lambda: opened.append(index_file.load(path).inverted_index(source.idf))) for _ in range(5))
    verified = timed(index_file.load(path).verify_postings)
    first = timed(lambda: opened[-1].votes(query[0]))
    removed = np.median([timed(lambda slot=slot: index.remove(slot)) for slot in range(0, index.n_slots, 100)])
    compacted = timed(index.compact)
    kind, size = "signatures" if signed else "votes", path.stat().st_size / 2**20
    print(
        f"\n{kind}, {opened[-1].n_slots:,} places on disk: {size:.0f} MiB, save {saved:.0f} ms, open {opening:.1f} ms,"
    )
    print(f"verify the postings {verified:.0f} ms, first votes after that {first:.1f} ms;", end=" ")
    print(f"remove {removed:.4f} ms, compact {compacted:.0f} ms\n", flush=True)


def plot(path: Path, rows: dict[str, list[tuple[int, float, float]]]) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(5, 3.4), dpi=110)
    for name, values in rows.items():
        places, p50, p99 = np.array(values).T
        (line,) = axes.plot(places, p50, marker="o", label=f"{name}, p50")
        axes.plot(places, p99, linestyle=":", color=line.get_color(), label=f"{name}, p99")
    peers = {"DBoW2 (p50)": ([1e3, 1e4, 1e5], [3.85, 59, 1098])}
    for name, (places, values) in peers.items():
        axes.plot(places, values, linestyle="--", color="grey", marker="x", label=name)
    axes.set(xscale="log", yscale="log", xlabel="places", ylabel="ms per query, top 20")
    axes.grid(True, which="major", alpha=0.3)
    axes.legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=Path)
    parser.add_argument("--places", type=int, default=SIZES[-1], help="the largest index")
    parser.add_argument("--plot", type=Path)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    quantising(options.images)
    training()
    source = Source(0)
    print(f"\n{N_WORDS:,} words, {PER_PLACE} per place, a query shares {source.common:.1f} words with a place\n")
    print("| index | places | query p50 ms | p99 ms | add ms | bytes per posting | MiB |")
    print("|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        rows = {
            "signatures" if signed else "votes": voting(source, options.places, signed, Path(folder))
            for signed in (False, True)
        }
    if options.plot:
        plot(options.plot, rows)


if __name__ == "__main__":
    main()
