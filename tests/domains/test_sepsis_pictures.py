"""The pictures of many episodes: what is drawn is what was given."""

import doctest

import numpy as np
import pytest

from oat_gym.domains import pictures
from oat_gym.errors import ConfigurationError, InvalidDataError
from oat_gym.ope import agreement_curve


def test_examples_in_docstrings():
    assert doctest.testmod(pictures).failed == 0


def test_shares_count_episodes_until_their_last_event(tmp_path):
    categories = [np.array([0, 1, 0]), np.array([1, 1])]
    times = [np.array([0.0, 10.0, 20.0]), np.array([0.0, 5.0])]
    path = tmp_path / "shares.png"
    figure = pictures.shares_over_time(categories, times, names=["well", "ill"], until=24.0, path=path)
    assert path.stat().st_size < 150_000
    upper, lower = figure.axes
    hours, present = lower.lines[0].get_data()
    assert present[hours <= 5].tolist() == [2.0] * (hours <= 5).sum()
    assert present[(hours > 5) & (hours <= 20)].max() == 1.0
    assert present[hours > 20].max() == 0.0
    well = upper.collections[0].get_paths()[0].vertices

    def height(hour):
        return well[np.isclose(well[:, 0], hour)][:, 1].max()

    assert (height(2.0), height(8.0), height(15.0), height(20.0)) == (0.5, 1.0, 0.0, 1.0)


def test_the_curve_is_drawn_where_there_are_episodes():
    curve = agreement_curve([0.1, 0.3, 0.5], [True, True, False], kind="at-least")
    figure = pictures.agreement({"a": curve, "b": curve}, event="shock")
    (axes,) = figure.axes
    lines = [container.lines[0] for container in axes.containers]
    np.testing.assert_allclose(lines[0].get_ydata(), [2 / 3, 0.5, 0.0])
    np.testing.assert_allclose(lines[0].get_xdata(), [0.0, 0.2, 0.4], atol=0.02)
    assert sorted(text.get_text() for text in axes.texts) == ["1", "1", "2", "2"]


@pytest.mark.parametrize("ending", ["svg", "jpg", "pdf", "png"])
def test_pictures_are_saved_in_every_format(tmp_path, ending):
    path = tmp_path / f"windows.{ending}"
    pictures.windows(np.zeros((3, 5, 2)), np.zeros((9, 2)), names=["a", "b"], path=str(path))
    assert path.stat().st_size > 1000


def test_windows_show_the_median_course():
    values = np.arange(5.0)[None, :, None] + np.array([0.0, 1.0, 10.0])[:, None, None]
    figure = pictures.windows(values, np.full((7, 1), 4.0), names=["heart_rate"])
    course, level = figure.axes[0].lines
    np.testing.assert_allclose(course.get_ydata(), np.arange(5.0) + 1)
    assert level.get_ydata()[0] == 4.0


def test_what_cannot_be_drawn_is_refused():
    with pytest.raises(ConfigurationError, match="Give 1 to 6 names"):
        pictures.shares_over_time([np.array([0])], [np.array([0.0])], names=[], until=1.0)
    with pytest.raises(InvalidDataError, match="equal lengths"):
        pictures.shares_over_time([np.array([0])], [np.array([0.0, 1.0])], names=["a"], until=1.0)
    with pytest.raises(ConfigurationError, match="curves, got 0"):
        pictures.agreement({})
    with pytest.raises(InvalidDataError, match="do not agree"):
        pictures.windows(np.zeros((2, 3, 4)), np.zeros((2, 3)), names=["a"])
