"""The picture of an evaluation of places: precision against recall."""

from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from seamark.service.picture import ACCEPTED, CORRECTED, DPI, GREY, INK
from seamark.service.places_metrics import Curve

SIZE_IN = (7.5, 5.5)


def draw_evaluation(found: Curve, report: dict[str, Any], path: Path) -> None:
    """Draw the curve, the chosen threshold and the recall at N as PNG; ``report`` is what build_report made."""
    figure = Figure(figsize=SIZE_IN, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.plot(found.recall, found.precision, color=CORRECTED, lw=2.2)
    threshold = report["threshold"]
    if threshold["score"] is not None:
        label = f"score {threshold['score']:.3f}: precision at least {threshold['precision_bound']:.3f} (95 % sure)"
        axes.plot(threshold["recall"], threshold["precision"], "o", ms=9, color=ACCEPTED, label=label)
        axes.legend(loc="lower left", frameon=False)
    axes.axvline(report["recall_at_full_precision"], color=GREY, lw=1.0, ls=(0, (4, 3)))
    axes.set_xlim(-0.02, 1.02)
    axes.set_ylim(-0.02, 1.04)
    axes.set_xlabel("recall: queries answered rightly, of those that have a true place")
    axes.set_ylabel("precision: right answers of all given")
    axes.grid(color=GREY, lw=0.4, alpha=0.5)
    values = [
        f"recall@{n} {'-' if value is None else format(value, '.3f')}" for n, value in report["recall_at"].items()
    ]
    full = f"{report['recall_at_full_precision']:.3f} at full precision"
    axes.set_title(f"{', '.join(values)}, {full}", fontsize=10, color=INK, loc="left")
    figure.savefig(path, format="png", dpi=DPI, facecolor="white", metadata={"Software": "Seamark"})
