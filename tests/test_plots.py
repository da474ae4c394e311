"""Pictures: what is drawn where, and that no global state is touched."""

import doctest
import subprocess
import sys

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from oat_gym import plots
from oat_gym.domains.maze2d import UMAZE
from oat_gym.errors import ConfigurationError, InvalidDataError


def walk(number, steps):
    """Positions encode (episode, step)."""
    return np.stack([np.arange(steps + 1) / 10.0, np.full(steps + 1, float(number))], axis=1)


WALKS = [walk(i, steps) for i, steps in enumerate((4, 7, 5))]
SPANS = [[(0, 0, 2), (2, 1, 5)], [(1, 3, 7)]]


def lines(axes):
    return [item for item in axes.collections if isinstance(item, LineCollection)]


def test_one_collection_for_the_rest_and_one_for_each_set():
    axes = Figure().subplots()
    plots.trajectories(axes, WALKS, maze=UMAZE.walls(), spans=[*SPANS, []])
    rest, first, second = lines(axes)
    assert [len(segment) for segment in rest.get_segments()] == [5, 8, 6]
    assert [len(segment) for segment in first.get_segments()] == [3, 5]
    np.testing.assert_allclose(first.get_segments()[1], WALKS[2][1:6])
    np.testing.assert_allclose(second.get_segments()[0], WALKS[1][3:8])
    assert len({tuple(item.get_colors()[0]) for item in (rest, first, second)}) == 3
    assert axes.get_aspect() == 1.0


def test_all_trajectories_are_in_view_beyond_the_maze():
    axes = Figure().subplots()
    plots.trajectories(axes, [walk(9, 80)], maze=UMAZE.walls())
    assert axes.get_xlim()[1] >= 8.0
    assert axes.get_ylim()[1] >= 9.0


def test_figure4_has_two_panels_on_one_scale_and_a_legend_with_supports(tmp_path):
    augmented = [rows + 0.05 for rows in WALKS]
    file = tmp_path / "figure4.png"
    figure = plots.figure4(WALKS, augmented, maze=UMAZE.walls(), spans=SPANS, path=file)
    left, right = figure.axes
    assert len(lines(left)) == len(lines(right)) == 3
    assert left.get_xlim() == right.get_xlim()
    np.testing.assert_allclose(lines(right)[2].get_segments()[0], augmented[1][3:8])
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts == ["PST set 0 (support 2 of 3)", "PST set 1 (support 1 of 3)", "rest of the trajectories"]
    assert file.read_bytes().startswith(b"\x89PNG")


def test_figure4_takes_more_augmented_trajectories_with_their_own_spans():
    augmented = [*WALKS, *WALKS]
    spans = [[(3, 0, 2), (5, 1, 5)], [(4, 3, 7), (1, 0, 1)]]
    figure = plots.figure4(WALKS, augmented, maze=UMAZE.walls(), spans=SPANS, augmented_spans=spans, supports=[3, 2])
    assert [len(item.get_segments()) for item in lines(figure.axes[1])] == [6, 2, 2]
    assert figure.legends[0].get_texts()[0].get_text() == "PST set 0 (support 3 of 3)"
    with pytest.raises(ConfigurationError, match="spans has 2 sets, augmented_spans 1 and supports 2"):
        plots.figure4(WALKS, WALKS, maze=UMAZE.walls(), spans=SPANS, augmented_spans=spans[:1])


def test_support_curve_shows_the_curve_and_the_choice(tmp_path):
    figure = plots.support_curve({20: 11, 5: 25, 10: 24}, episodes=25, chosen=10, path=tmp_path / "curve.svg")
    curve = figure.axes[0].get_lines()[0]
    assert curve.get_xdata().tolist() == [5, 10, 20]
    assert curve.get_ydata().tolist() == [25, 24, 11]
    assert "W = 10" in [text.get_text() for text in figure.legends[0].get_texts()]
    assert (tmp_path / "curve.svg").stat().st_size > 0
    with pytest.raises(ConfigurationError, match=r"chosen=7 is not on the curve; .*\[5\]"):
        plots.support_curve({5: 1}, chosen=7)
    with pytest.raises(InvalidDataError, match="empty"):
        plots.support_curve({})


def test_maze_figure_marks_starts_and_ends(tmp_path):
    figure = plots.maze_figure(WALKS, maze=UMAZE.walls(), title="walks", path=tmp_path / "maze.png")
    axes = figure.axes[0]
    starts, ends = (item.get_offsets() for item in axes.collections[-2:])
    np.testing.assert_allclose(starts, [rows[0] for rows in WALKS])
    np.testing.assert_allclose(ends, [rows[-1] for rows in WALKS])
    assert axes.get_title() == "walks"
    assert (tmp_path / "maze.png").exists()


def test_fidelity_has_a_panel_a_metric_a_dot_a_method_and_a_line_where_real_data_lies(tmp_path):
    panels = [
        plots.Panel("share", "share", [0.2, None, 0.9], [0.5, 0.5, 0.4], limits=(0, 1)),
        plots.Panel("nothing", "sd", [None, None, None]),
        plots.Panel("ratio", "ratio", [0.1, 1.0, 50.0], [1.0, 1.0, None]),
        plots.Panel("difference", "sd", [-0.1, 0.0, 0.3]),
    ]
    figure = plots.fidelity(["a", "b", "c"], panels, title="methods", path=tmp_path / "fidelity.png")
    share, ratio, difference = [axes for axes in figure.axes if axes.get_visible()]
    dots = [(line.get_xdata()[0], line.get_ydata()[0]) for line in share.get_lines()]
    assert dots == [(0.2, 0), (0.9, 2)]
    assert [text.get_text() for text in share.texts] == ["none"]
    upright = [item.get_segments()[0] for item in lines(share) if np.ptp(item.get_segments()[0][:, 0]) == 0]
    np.testing.assert_allclose([segment[0, 0] for segment in upright], [0.5, 0.4])
    np.testing.assert_allclose(share.get_xticks(), [0, 0.5, 1])
    assert (share.get_xscale(), ratio.get_xscale(), difference.get_xscale()) == ("linear", "log", "linear")
    assert [label.get_text() for label in share.get_yticklabels()] == ["a", "b", "c"]
    assert share.get_ylim()[0] > share.get_ylim()[1]  # the first method is on top
    assert difference.get_xlim()[0] < -0.1
    assert (tmp_path / "fidelity.png").read_bytes().startswith(b"\x89PNG")


def test_fidelity_refuses_other_numbers_of_values_and_nothing_to_draw():
    with pytest.raises(InvalidDataError, match="'MMD' has 1 values, 0 references; expected 2"):
        plots.fidelity(["a", "b"], [plots.Panel("MMD", "squared", [0.1])])
    with pytest.raises(InvalidDataError, match="has 2 values, 1 references"):
        plots.fidelity(["a", "b"], [plots.Panel("MMD", "squared", [0.1, 0.2], [0.3])])
    with pytest.raises(InvalidDataError, match="nothing to draw"):
        plots.fidelity(["a"], [plots.Panel("MMD", "squared", [None])])


@pytest.mark.parametrize("span", [(3, 0, 1), (-1, 0, 1), (0, 2, 2), (0, -1, 2), (0, 3, 5)])
def test_spans_outside_their_episode_are_refused(span):
    with pytest.raises(InvalidDataError, match="Set 1 has the span"):
        plots.maze_figure(WALKS, spans=[[span]])


def test_other_shapes_and_too_many_sets_are_refused():
    with pytest.raises(InvalidDataError, match=r"Trajectory 1 has shape \(4, 1\)"):
        plots.maze_figure([WALKS[0], np.zeros((4, 1))])
    with pytest.raises(InvalidDataError, match=r"maze has shape \(5, 5\)"):
        plots.maze_figure(WALKS, maze=np.array(UMAZE.cells))
    with pytest.raises(ConfigurationError, match="7 sets were given and 6"):
        plots.maze_figure(WALKS, spans=[[]] * 7)


def test_the_set_colours_differ_in_lightness_or_hue_from_each_other_and_the_rest():
    """Distances of the colours as a deuteranope sees them (Vienot 1999), in the paper's order."""
    to_lms = np.array([[17.8824, 43.5161, 4.11935], [3.45565, 27.1554, 3.86714], [0.0299566, 0.184309, 1.46709]])
    deuteranope = np.array([[1, 0, 0], [0.494207, 0, 1.24827], [0, 0, 1]])
    colors = (*plots.SET_COLORS[:3], plots.REST_COLOR)
    rgb = np.array([[int(color[i : i + 2], 16) / 255 for i in (1, 3, 5)] for color in colors]) ** 2.2
    seen = rgb @ (np.linalg.inv(to_lms) @ deuteranope @ to_lms).T
    distance = np.linalg.norm(seen[:, None] - seen[None], axis=2)
    assert distance[~np.eye(len(colors), dtype=bool)].min() > 0.1


def test_pyplot_and_back_ends_are_left_alone():
    code = (
        "import sys, numpy as np; from oat_gym import plots; assert 'matplotlib' not in sys.modules;"
        "plots.maze_figure([np.zeros((2, 2))]); assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_examples_in_docstrings():
    assert doctest.testmod(plots).failed == 0
