"""How the viewer lays a recording out; the layout travels inside the file."""

from typing import Any

from seamark.frontend.types import Mode

FRAME_TIMELINE = "frame"
PLOTS = ("inliers", "quality", "reprojection_px", "latency_ms", "loop_score", "loop_inliers")
PLOTS_OF_PLACES = ("loop_score", "loop_inliers", "latency_ms")


def blueprint(mode: Mode) -> Any:
    """Return the layout: map, camera, loops with their image pairs, log and plots; no map in mode places."""
    import rerun.blueprint as rrb

    names = PLOTS_OF_PLACES if mode is Mode.PLACES else PLOTS
    plots = [rrb.TimeSeriesView(origin=f"/plots/{name}", name=name) for name in names]
    pairs = rrb.Tabs(
        rrb.Spatial2DView(origin="/loops/accepted/pair", name="Loops accepted"),
        rrb.Spatial2DView(origin="/loops/rejected/pair", name="Loops rejected"),
        rrb.TextLogView(origin="/", contents=["/logs", "/loops/**"], name="Log"),
    )
    camera = rrb.Spatial2DView(origin="/world/cam/image", name="Camera")
    if mode is Mode.PLACES:
        body = rrb.Vertical(rrb.Horizontal(camera, pairs), rrb.Tabs(*plots), row_shares=[3, 1])
    else:
        contents = ["/world/**", "- /world/cam/image/points", "- /world/cam/image/tracks"]
        world = rrb.Spatial3DView(origin="/world", name="Map", contents=contents)
        side = rrb.Vertical(camera, pairs, rrb.Tabs(*plots), row_shares=[3, 3, 2])
        body = rrb.Horizontal(world, side, column_shares=[3, 2])
    return rrb.Blueprint(
        body,
        rrb.TimePanel(state="collapsed", timeline=FRAME_TIMELINE),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )
