"""Pictures of plans: every cell has the colour of its source, and the same plan is the same file."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.text import Annotation, Text
from PIL import Image

from ttscompile.core.lattice import Source
from ttscompile.errors import IllegalPlanError
from ttscompile.measure.points import Point
from ttscompile.plots.figure import write_picture
from ttscompile.plots.frontier import plot_chunk, plot_frontier
from ttscompile.plots.maps import COLOURS, plot_plan


def pixels_of(source: Source, picture: Path) -> int:
    """Pixels of exactly the source's colour."""
    wanted = np.round(np.array(to_rgb(COLOURS[source])) * 255)
    return int(np.all(np.asarray(Image.open(picture).convert("RGB")) == wanted, axis=-1).sum())


def test_colours_cover_the_picture_as_the_plan_says(tmp_path: Path) -> None:
    plan = np.full((20, 10), Source.TIMESTEP, np.int8)
    plan[0] = Source.COMPUTE  # 10 cells
    plan[5:15, 2] = Source.FORWARD  # 10 cells
    plan[5:15, 4:8] = Source.ROLLOUT  # 40 cells, which leaves 140
    write_picture(plot_plan(plan, ["feed_forward"] * 10, "a plan"), tmp_path / "plan.png")
    counts = {source: pixels_of(source, tmp_path / "plan.png") for source in Source}
    cell = counts[Source.TIMESTEP] / 140
    assert cell > 50, "a cell of the picture is too small to be seen"
    # Grid lines and the patches of the legend blur the figures.
    for source, cells in {Source.COMPUTE: 10, Source.FORWARD: 10, Source.ROLLOUT: 40}.items():
        assert counts[source] / cell == pytest.approx(cells, abs=3)


def test_the_same_plan_is_the_same_file(tmp_path: Path) -> None:
    plan = np.zeros((4, 2), np.int8)
    for name in ("a.png", "b.png"):
        write_picture(plot_plan(plan, ["self_attention", "x"]), tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


@pytest.mark.parametrize("steps", [4, 20, 100])
def test_steps_are_whole_numbers(steps: int) -> None:
    figures = [
        plot_plan(np.zeros((steps, 2), np.int8), ["a", "b"]),
        plot_chunk(np.zeros((steps, 2), np.float32), range(1), ""),
    ]
    for figure in figures:
        figure.canvas.draw()
        labels = [text.get_text() for text in figure.axes[0].get_xticklabels() if text.get_text()]
        assert len(labels) > 3 and not [text for text in labels if "." in text]


def test_a_name_that_is_moved_from_its_point_is_led_to_it() -> None:
    near = [Point("s", name, 0.1 + 1e-4 * n, 5.0 + n / 100) for n, name in enumerate("ab")]
    texts = frontier_of([*near, Point("s", "c", 0.01, 50.0)]).axes[0].texts
    assert [text.get_text() for text in texts] == ["a", "b", "c"]
    assert [isinstance(text, Annotation) and text.arrow_patch is not None for text in texts] == [False, True, False]


def test_names_on_both_sides_of_their_points_leave_each_other_room() -> None:
    """That of the last point stands to its left, where that of the point before it is."""
    points = [
        Point("s", "a", 0.2, 9.5),
        Point("s", "schedule", 0.0878, 20.2),
        Point("s", "original.12@fp32", 0.0863, 26.8),
    ]
    boxes = [Text.get_window_extent(text) for text in frontier_of(points).axes[0].texts]  # without the line to a point
    assert not [pair for pair in combinations(boxes, 2) if pair[0].overlaps(pair[1])]


def test_plans_of_one_distance_are_beside_each_other_and_no_tick_has_the_label_of_another() -> None:
    axes = frontier_of([Point("s", "fast", 0.1116, 41.4), Point("s", "schedule", 0.11156, 68.5)]).axes[0]
    labels = [t.get_text() for t in axes.get_yticklabels(which="both") if t.get_text()]
    low, high = axes.get_ylim()
    assert len(labels) == len(set(labels)) > 0 and high > 1.4 * low


@pytest.mark.parametrize("plan", [np.zeros((4, 3), np.int8), np.full((4, 2), 4, np.int8), np.zeros((1, 4, 2), np.int8)])
def test_what_is_no_plan_of_these_blocks_is_refused(plan: np.ndarray) -> None:
    with pytest.raises(IllegalPlanError, match=r"expected \[K, 2\]"):
        plot_plan(plan, ["self_attention", "feed_forward"])


def frontier_of(points: list[Point]) -> Figure:
    """The figure of a frontier, laid out."""
    figure = plot_frontier(points, sorted(points, key=lambda p: p.latency_ms), "title")
    figure.canvas.draw()
    return figure


def test_logarithmic_axes_have_plain_numbers_and_names_stay_inside() -> None:
    points = [Point("s", "quick", 2.0, 0.5), Point("s", "a long name of a plan", 0.03, 130.0)]
    figure = frontier_of(points)
    (axes,) = figure.axes
    labels = [t for axis in (axes.xaxis, axes.yaxis) for t in axis.get_ticklabels(which="both") if t.get_text()]
    assert {"0.1", "1", "100"} <= {t.get_text() for t in labels}
    assert not [t.get_text() for t in labels if set(t.get_text()) - set("0123456789.")]
    across = [t.get_window_extent().y1 for t in axes.get_xticklabels(which="both") if t.get_text()]
    assert np.ptp(across) < 0.5, "labels of major and minor ticks stand at different heights"
    frame = axes.get_window_extent()
    assert all(frame.x0 < t.get_window_extent().x0 and t.get_window_extent().x1 < frame.x1 for t in axes.texts)


def test_the_frontier_of_one_point_is_no_line_and_the_dense_plan_is_told() -> None:
    figure = frontier_of([Point("s", "quick", 2.0, 5.0), Point("s", "dense", 0.0, 99.0)])
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["s"]
    assert "dense of s, 99 ms" in figure.axes[0].get_title(loc="left")


def test_what_may_not_be_taken_is_a_grey_ring() -> None:
    points = [Point("too far", "a", 0.5, 5.0), Point("may be taken", "b", 0.05, 9.0)]
    figure = plot_frontier(points, points[1:], "title", "too far")
    looks = [(str(line.get_fillstyle()), str(line.get_color())) for line in figure.axes[0].lines]
    assert looks == [("none", "#999999"), ("full", "#0072b2")]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["too far", "may be taken"]


def test_many_series_are_told_apart_and_the_original_but_for_rounding_takes_no_room() -> None:
    points = [Point(f"rule {i}", "0.95", 0.5 + 0.05 * i, 5.0 + i) for i in range(9)]
    axes = frontier_of([*points, Point("s", "dense", 2e-7, 99.0)]).axes[0]
    looks = [(str(line.get_color()), str(line.get_marker())) for line in axes.lines[:9]]
    assert len(set(looks)) == 9
    assert {"rule 0 0.95", "rule 8 0.95"} <= {text.get_text() for text in axes.texts}
    assert axes.get_ylim()[0] > 0.1
    assert "dense of s, 99 ms" in axes.get_title(loc="left")
