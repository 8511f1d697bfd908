"""Pictures: each committed one, and one of each drawing function, is whole, and its legend holds all series."""

import re

import pytest

from benchmarks import peers
from benchmarks.table import evidence, pictures, table
from support.rendering import assert_is_whole
from warp_spo.trials import report
from warp_spo.viewing import charts

RESULTS = evidence.RESULTS
TOLERANCE = {"float32": 1e-4, "float64": 1e-10}
TITLE = "robot: 3 bodies, 4 dof, 64 worlds on cpu"


@pytest.fixture(scope="module")
def pyplot():
    return charts.load_pyplot()


@pytest.fixture(scope="module")
def machines():
    """Evidence of each machine in the committed results: a GPU and a CPU."""
    return evidence.gather(evidence.read(file) for file in evidence.files([RESULTS]))


def legends(figure):
    """Return the texts of all legends of a figure, its panels' too."""
    found = [*figure.legends, *(axes.get_legend() for axes in figure.axes)]
    return [text.get_text() for legend in found if legend for text in legend.get_texts()]


def written(svg):
    """Return the texts of an SVG, whose letters are outlines: Matplotlib leaves each text in a comment."""
    return set(re.findall(r"<!-- (.*?) -->", svg))


@pytest.mark.parametrize("file", sorted(RESULTS.rglob("*.svg")), ids=lambda file: file.name)
def test_committed_pictures_are_whole(file):
    assert_is_whole(file.read_text())


def test_all_pictures_of_the_results_are_committed(machines, pyplot):
    """Each as it is drawn from the results: its size and its texts."""
    for name, draw in zip(table.PICTURES, (pictures.headline, pictures.scaling), strict=True):
        figure = draw(pyplot, machines[0])
        text, committed = charts.svg(figure), (RESULTS / name).read_text()
        pyplot.close(figure)
        assert re.search('viewBox="(.*?)"', text)[1] == re.search('viewBox="(.*?)"', committed)[1]
        assert written(text) == written(committed), f"{name}: draw it again with python -m benchmarks --readme"


@pytest.mark.parametrize("machine", [0, 1])
def test_error_against_run_time_names_all_libraries_and_precisions(machines, pyplot, machine):
    found = machines[machine]
    figure = pictures.headline(pyplot, found)
    names = legends(figure)
    assert {"warp_spo", "float32", "float64"} <= set(names)
    if found.is_gpu:
        of = [row for row in found.peers if row["op"] == "mass_matrix"]
        assert of and all(any(charts.library(row["peer"]) in name for name in names) for row in of)
    assert_is_whole(charts.svg(figure))
    pyplot.close(figure)


@pytest.mark.parametrize("machine", [0, 1])
def test_run_time_against_size_names_its_lines(machines, pyplot, machine):
    figure = pictures.scaling(pyplot, machines[machine])
    assert legends(figure) == ["forward_dynamics", "inverse_dynamics", pictures.GUIDE, pictures.RANGE]
    svg = charts.svg(figure)
    assert {"Arm, 7 dof", "Humanoid, 27 dof", "Chain", "Random tree"} <= written(svg)
    assert_is_whole(svg)
    pyplot.close(figure)


def _rows(dtypes, errors=(3e-8, 0.0, float("nan"), 2.0)):
    names = ("phi", "mass_matrix", "an_operation_with_quite_a_long_name", "forward_dynamics")
    return [dict(op=name, granularity="tree", dtype=dtype, worlds=64, seconds=1e-5 * (1 + k), error=error,
                 least=0.1 * error, range=(0.9e-5 * (1 + k), 3e-5 * (1 + k)))
            for dtype in dtypes for k, (name, error) in enumerate(zip(names, errors, strict=True))]  # fmt: skip


@pytest.mark.parametrize("dtypes", [("float32",), ("float32", "float64")])
def test_picture_of_the_main_job_names_every_operation(pyplot, dtypes):
    figure = report.picture(pyplot, TITLE, _rows(dtypes), TOLERANCE)
    svg = charts.svg(figure)
    assert legends(figure) == [*(f"warp_spo, {dtype}" for dtype in dtypes), "beyond the tolerance", report.BARS]
    assert {"phi", "mass_matrix", "forward_dynamics", f"{TITLE}: lower left is better"} <= written(svg)
    assert "float32, tolerance 10⁻⁴, 1 without a result" in written(svg)
    assert_is_whole(svg)
    pyplot.close(figure)


def test_a_picture_of_one_point_or_none_is_whole(pyplot):
    for errors in ((1e-7,), (0.0,), (float("nan"),)):
        rows = [dict(op="phi", dtype="float32", seconds=1e-5, range=(1e-5, 1e-5), error=error, least=error)
                for error in errors]  # fmt: skip
        figure = report.picture(pyplot, TITLE, rows, TOLERANCE)
        assert_is_whole(charts.svg(figure))
        pyplot.close(figure)


def test_every_library_has_a_colour_of_its_own():
    colors = [charts.OURS, charts.OTHER, *charts.LIBRARIES.values()]
    assert len(set(colors)) == len(colors) and len(charts.LIBRARIES) == len(peers.PEERS) - 1  # two peers are torch's
    assert charts.color("dense resolvent in torch 2.11") == charts.color("torch 2.13") != charts.color("P 1")
    assert charts.color(None) == charts.OURS


def test_axes_have_plain_numbers():
    assert [charts.time_text(us) for us in (0.5, 20.0, 1e3, 3e5, 2e6)] == ["0.5 µs", "20 µs", "1 ms", "300 ms", "2 s"]
    assert [charts.power_text(error) for error in (1e-7, 3e-15, 1.0)] == ["10⁻⁷", "3×10⁻¹⁵", "10⁰"]
    assert [charts.count_text(n) for n in (1, 100, 1e3, 1e6)] == ["1", "100", "1k", "1M"]


@pytest.mark.parametrize("ends", [(72.0, 95.0), (1.0, 9.0), (30.0, 200.0), (1e-7, 4e-7), (3.0, 3e4), (1.0, 1e9)])
def test_labels_of_ticks_do_not_touch(pyplot, ends):
    """On axes of less than a decade, too, and at least one is there."""
    with charts.style():
        figure, grid = pyplot.subplots(2, 3, figsize=(10.4, 6.0), layout="constrained")
    for axes in grid.flat:
        charts.log_axis(axes.xaxis, ends, charts.time_text)
        charts.log_axis(axes.yaxis, ends, charts.power_text)
    charts.finish_layout(figure)
    renderer = figure.canvas.get_renderer()
    for axis in (grid[0][1].xaxis, grid[0][1].yaxis):
        low, high = sorted(axis.get_view_interval())
        labels = [label for label in axis.get_ticklabels() if label.get_text()]
        boxes = [label.get_window_extent(renderer).padded(1.0) for label in labels]
        assert boxes and all(low <= place <= high for place in axis.get_ticklocs())
        assert not any(a.overlaps(b) for k, a in enumerate(boxes) for b in boxes[:k])
    pyplot.close(figure)


def test_names_do_not_hide_each_other(pyplot):
    """Twelve points close together: all names are inside the panel and no two overlap."""
    with charts.style():
        figure, axes = pyplot.subplots(figsize=(6.0, 4.0), layout="constrained")
    values = [10.0 ** (0.05 * k) for k in range(12)]
    charts.log_axis(axes.xaxis, [1.0, 100.0], charts.time_text)
    charts.log_axis(axes.yaxis, [1.0, 100.0], charts.power_text)
    charts.finish_layout(figure)
    charts.label_points(axes, [charts.ChartPoint(x, x, f"library {x:.2f}", charts.OURS) for x in values])
    renderer = figure.canvas.get_renderer()
    boxes = [text.get_window_extent(renderer) for text in axes.texts]
    frame = axes.get_window_extent(renderer).padded(1.0)
    assert len(boxes) == 12
    for k, box in enumerate(boxes):
        assert frame.contains(box.x0, box.y0) and frame.contains(box.x1, box.y1)
        shared = [other.intersection(box, other) for other in boxes[:k]]
        assert all(each is None or each.width * each.height < 2.0 for each in shared)
    pyplot.close(figure)
