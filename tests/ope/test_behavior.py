"""The behaviour policy: densities that are densities, known policies recovered, episodes not seen by their judge."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from gymnasium import spaces

from oat_gym import domains, ope
from oat_gym.episodes import Transitions
from oat_gym.errors import ConfigurationError, InvalidDataError, TrainingError
from oat_gym.ope import BehaviorCloning, Logged, fit_log_prob
from oat_gym.ope._densities import ActionHead, mixture_from, tanh_gaussian_from, tanh_gaussian_log_prob
from oat_gym.ope.behavior import choose_density
from oat_gym.spaces import FlatSpace, Layout

QUICK = BehaviorCloning(hidden=(32,), max_updates=400, patience=150, folds=3)
LINE = spaces.Box(-np.inf, np.inf, (1,))


def logged(
    states: np.ndarray,
    actions: np.ndarray,
    lengths: list[int],
    *,
    action_space: spaces.Space = LINE,
    unit: list[int] | None = None,
    synthetic: list[bool] | None = None,
) -> Logged:
    """Return logged steps of given states (n, D) and actions, without a dataset around them."""
    n, episodes = len(states), len(lengths)
    made = np.zeros(episodes, dtype=bool) if synthetic is None else np.array(synthetic)
    episode = np.repeat(np.arange(episodes), lengths)
    return Logged(
        steps=Transitions(
            observations=states,
            actions=actions,
            rewards=np.zeros(n),
            next_observations=states,
            terminated=np.zeros(n, dtype=bool),
            truncated=np.zeros(n, dtype=bool),
            episode=episode,
            step=np.concatenate([np.arange(length) for length in lengths]),
            synthetic=made[episode],
        ),
        flat_observations=FlatSpace.of(spaces.Box(-np.inf, np.inf, states.shape[1:])),
        flat_actions=FlatSpace.of(action_space),
        offsets=np.concatenate(([0], np.cumsum(lengths))),
        unit=np.arange(episodes) if unit is None else np.array(unit),
        synthetic=made,
    )


def linear_gaussian(n: int = 3000, *, bound: float | None = None, sd: float = 0.5, seed: int = 0) -> Logged:
    """Return steps of a ~ N(1.5 s - 0.5, sd^2), perhaps clipped."""
    generator = np.random.default_rng(seed)
    states = generator.normal(size=(n, 1))
    actions = 1.5 * states - 0.5 + sd * generator.normal(size=(n, 1))
    lengths = [n // 10] * 10
    if bound is None:
        return logged(states, actions, lengths)
    box = spaces.Box(-bound, bound, (1,), dtype=np.float64)
    return logged(states, np.clip(actions, -bound, bound), lengths, action_space=box)


def every(data: Logged) -> np.ndarray:
    return np.ones(len(data), dtype=bool)


def head(density: str, *, low: float = -2.0, high: float = 3.0, components: int = 3) -> ActionHead:
    def one(value: float) -> torch.Tensor:
        return torch.full((1, 1, 1), value, dtype=torch.float64)

    middle, half = ((low + high) / 2, (high - low) / 2) if density == "tanh-gaussian" else (0.4, 1.7)
    bounds = (torch.tensor([bound], dtype=torch.float64) for bound in (low, high))
    return ActionHead(Layout(1, (0,), ()), density, components, 0.01, one(middle), one(half), *bounds)  # type: ignore[arg-type]


def density_over(form: ActionHead, grid: np.ndarray, seed: int) -> np.ndarray:
    output = torch.from_numpy(np.random.default_rng(seed).normal(size=(1, 1, form.width)))
    values = torch.from_numpy(grid)[None, :, None]
    return form.log_prob(output.expand(1, len(grid), -1), values)[0].exp().numpy()


# Densities


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("density", ["gaussian", "mixture"])
def test_unbounded_densities_integrate_to_one(density: str, seed: int) -> None:
    grid = np.linspace(-60, 60, 200_001)
    assert np.trapezoid(density_over(head(density), grid, seed), grid) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_the_tanh_gaussian_integrates_to_one_inside_its_bounds(seed: int) -> None:
    output = torch.from_numpy(np.random.default_rng(seed).normal(size=(1, 2)))
    before = torch.linspace(-4.9, 4.9, 400_001, dtype=torch.float64)  # the grid is fine where the density is steep
    x = before.tanh()
    density = tanh_gaussian_log_prob(tanh_gaussian_from(output), x[:, None])[:, 0].exp()
    mean, scale = tanh_gaussian_from(output)
    missing = torch.distributions.Normal(mean, scale).cdf(torch.tensor([-4.9, 4.9]))[0]
    expected = float(missing[1] - missing[0])
    assert float(torch.trapezoid(density, x)) == pytest.approx(expected, abs=1e-5)
    # in the units of the actions, whose range is 2.5 times as wide
    grid = x.numpy() * 2.5 + 0.5
    assert np.trapezoid(density_over(head("tanh-gaussian"), grid, seed), grid) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("seed", range(3))
def test_the_censored_gaussian_integrates_to_one_with_its_atoms(seed: int) -> None:
    form = head("censored", low=-0.5, high=1.0)
    grid = np.linspace(-0.5, 1.0, 200_001)
    inside = np.trapezoid(density_over(form, grid[1:-1], seed), grid[1:-1])
    atoms = density_over(form, np.array([-0.5, 1.0]), seed)
    assert inside + atoms.sum() == pytest.approx(1.0, abs=1e-4)
    assert atoms.min() > 0.01


@pytest.mark.parametrize("density", ["gaussian", "censored", "tanh-gaussian", "mixture"])
def test_samples_follow_the_density(density: str) -> None:
    form = head(density)
    output = torch.from_numpy(np.random.default_rng(1).normal(size=(1, 1, form.width)))
    drawn = form.sample(output.expand(1, 50_000, -1), torch.Generator().manual_seed(0))[0, :, 0].numpy()
    grid = np.linspace(-2 + 3e-4, 3 - 3e-4, 50_001)
    mass = np.cumsum(density_over(form, grid, 1)) * (grid[1] - grid[0])
    for at in (10_000, 25_000, 40_000):
        below = (drawn > grid[0]) & (drawn <= grid[at])
        assert below.mean() == pytest.approx(mass[at], abs=0.015)


def test_a_mixture_of_equal_parts_is_one_gaussian() -> None:
    output = torch.tensor([[0.3, -2.0, 0.5, 0.1, 0.5, 0.1]])  # two weights; mean 0.5 and raw scale 0.1 twice
    log_weights, parts = mixture_from(output, 2, 0.01)
    assert float(log_weights.exp().sum()) == pytest.approx(1.0)
    assert torch.equal(parts.mean[0, 0], parts.mean[0, 1])


# Recovery


def test_a_known_linear_gaussian_is_recovered() -> None:
    data = linear_gaussian()
    fit = fit_log_prob(data, config=replace(QUICK, max_updates=1500), seed=0, episodes=every(data))
    assert fit.density == "gaussian"
    truth = ope.GaussianPolicy(lambda s: 1.5 * s - 0.5, 0.5)
    exact = truth.log_prob(data.steps.observations, data.steps.actions)
    assert fit.held_out_log_likelihood == pytest.approx(exact.mean(), abs=0.05)
    assert fit.held_out_log_likelihood == pytest.approx(fit.log_prob.mean())
    assert np.abs(fit.log_prob - exact).mean() < 0.1
    grid = np.linspace(-1.5, 1.5, 7)[:, None]
    np.testing.assert_allclose(fit.policy().mean(grid), 1.5 * grid - 0.5, atol=0.15)
    drawn = fit.policy().sample(np.zeros((20_000, 1)), rng=np.random.default_rng(0))
    assert drawn.std() == pytest.approx(0.5, abs=0.06)


def test_clipped_actions_are_recovered_by_the_censored_gaussian() -> None:
    data = linear_gaussian(bound=1.0)
    config = replace(QUICK, density="censored", max_updates=700)
    fit = fit_log_prob(data, config=config, seed=0, episodes=every(data))
    truth = ope.GaussianPolicy(
        lambda s: 1.5 * s - 0.5,
        0.5,
        action_space=data.flat_actions.space,
        censored=True,  # type: ignore[arg-type]
    )
    exact = truth.log_prob(data.steps.observations, data.steps.actions)
    assert fit.held_out_log_likelihood == pytest.approx(exact.mean(), abs=0.05)
    # ratios against the truth average 1, atoms included: both count the same way
    assert np.exp(exact - fit.log_prob).mean() == pytest.approx(1.0, abs=0.05)


def test_a_mixture_finds_two_modes_that_a_gaussian_cannot() -> None:
    generator = np.random.default_rng(0)
    states = generator.normal(size=(2000, 1))
    actions = generator.choice([-1.0, 1.0], size=(2000, 1)) + 0.1 * generator.normal(size=(2000, 1))
    data = logged(states, actions, [200] * 10)
    config = replace(QUICK, folds=2, density="mixture", components=2, max_updates=700)
    fit = fit_log_prob(data, config=config, seed=0, episodes=every(data))
    exact = -np.log(0.1) - 0.5 * np.log(2 * np.pi) - 0.5 - np.log(2)
    best_gaussian = -0.5 * np.log(2 * np.pi * 1.01) - 0.5
    assert fit.held_out_log_likelihood == pytest.approx(exact, abs=0.1)
    assert fit.held_out_log_likelihood > best_gaussian + 0.5


def test_known_probabilities_are_recovered() -> None:
    generator = np.random.default_rng(0)
    table = np.array([[0.7, 0.2, 0.1], [0.1, 0.1, 0.8]])
    states = generator.integers(0, 2, size=6000)
    actions = ope.TabularPolicy(table).sample(states, rng=generator) + 4
    data = logged(np.eye(2)[states], actions, [600] * 10, action_space=spaces.Discrete(3, start=4))
    fit = fit_log_prob(data, config=QUICK, seed=0, episodes=every(data))
    assert fit.density == "categorical"
    policy = fit.policy()
    assert isinstance(policy, ope.DiscretePolicy)
    np.testing.assert_allclose(policy.probabilities(np.eye(2)), table, atol=0.04)
    assert policy.mean(np.eye(2)).tolist() == [4, 6]
    np.testing.assert_allclose(policy.log_prob(np.eye(2), np.array([4, 6])), np.log([0.7, 0.8]), atol=0.06)


def test_several_discrete_actions_are_independent_categoricals() -> None:
    generator = np.random.default_rng(0)
    actions = np.stack([generator.random(4000) < 0.8, generator.integers(0, 4, 4000)], axis=1).astype(np.int64)
    data = logged(np.zeros((4000, 1)), actions, [400] * 10, action_space=spaces.MultiDiscrete([2, 4]))
    fit = fit_log_prob(data, config=replace(QUICK, folds=2), seed=0, episodes=every(data))
    pairs = np.array([[first, second] for first in range(2) for second in range(4)])
    values = np.exp(fit.policy().log_prob(np.zeros((8, 1)), pairs))
    assert values.sum() == pytest.approx(1.0, abs=1e-5)
    np.testing.assert_allclose(values, np.repeat([0.05, 0.2], 4), atol=0.05)


# Cross-fitting


def test_an_episode_is_judged_by_a_network_that_never_saw_it_nor_its_copies() -> None:
    generator = np.random.default_rng(0)
    states, actions = generator.normal(size=(240, 2)), generator.normal(size=(240, 1))
    lengths, unit = [40, 20, 30, 30, 40, 20, 30, 30], [0, 1, 2, 3, 0, 1, 2, 3]
    synthetic = [False] * 4 + [True] * 4
    data = logged(states, actions, lengths, unit=unit, synthetic=synthetic)
    config = replace(QUICK, folds=2, max_updates=60, validation=0.0)
    before = fit_log_prob(data, config=config, seed=0, episodes=every(data))
    rows = np.isin(data.steps.episode, (1, 5))  # real episode 1 and its copy
    judge = before.folds[before.fold[1]]

    altered_actions, altered_states = actions.copy(), states.copy()
    altered_actions[rows] += 100.0
    altered_states[rows] -= 50.0
    altered = logged(altered_states, altered_actions, lengths, unit=unit, synthetic=synthetic)
    after = fit_log_prob(altered, config=config, seed=0, episodes=every(data))
    new_judge = after.folds[after.fold[1]]
    np.testing.assert_array_equal(
        judge.log_prob(states[rows], actions[rows]), new_judge.log_prob(states[rows], actions[rows])
    )
    np.testing.assert_array_equal(before.log_prob[rows], judge.log_prob(states[rows], actions[rows]))
    others = after.fold[data.unit[data.steps.episode]] != after.fold[1]
    assert not np.allclose(before.log_prob[others], after.log_prob[others])  # theirs did see it


def test_only_the_chosen_episodes_are_trained_on() -> None:
    generator = np.random.default_rng(0)
    states, actions = generator.normal(size=(150, 1)), generator.normal(size=(150, 1))
    lengths, unit, synthetic = [30] * 5, [0, 1, 2, 0, 1], [False, False, False, True, True]
    data = logged(states, actions, lengths, unit=unit, synthetic=synthetic)
    config = replace(QUICK, folds=3, max_updates=40, validation=0.0)
    real = ~data.synthetic
    before = fit_log_prob(data, config=config, seed=0, episodes=real)
    actions = actions.copy()
    actions[90:] = 77.0  # synthetic ones
    other = logged(states, actions, lengths, unit=unit, synthetic=synthetic)
    after = fit_log_prob(other, config=config, seed=0, episodes=real)
    np.testing.assert_array_equal(before.log_prob[:90], after.log_prob[:90])
    assert after.log_prob.shape == (150,)
    assert before.held_out_log_likelihood == after.held_out_log_likelihood


def test_in_sample_log_probabilities_are_higher_than_cross_fitted_ones() -> None:
    generator = np.random.default_rng(0)
    data = logged(generator.normal(size=(60, 4)), generator.normal(size=(60, 2)), [10] * 6,
                  action_space=spaces.Box(-np.inf, np.inf, (2,)))  # fmt: skip
    config = BehaviorCloning(hidden=(64,), max_updates=150, validation=0.0, folds=3)
    crossed = fit_log_prob(data, config=config, seed=0, episodes=every(data))
    inside = fit_log_prob(data, config=replace(config, folds=1), seed=0, episodes=every(data))
    assert inside.log_prob.mean() > crossed.log_prob.mean() + 1.0


def test_the_fit_is_a_function_of_the_seed() -> None:
    data = linear_gaussian(200)
    config = replace(QUICK, max_updates=30)
    first, again, other = (fit_log_prob(data, config=config, seed=s, episodes=every(data)) for s in (1, 1, 2))
    np.testing.assert_array_equal(first.log_prob, again.log_prob)
    assert not np.array_equal(first.log_prob, other.log_prob)


@pytest.mark.parametrize("episodes", [[0, 1], [3, 7], [0, 9]])
def test_folds_are_cut_from_what_may_be_trained_on(episodes: list[int]) -> None:
    data = linear_gaussian(100)
    chosen = np.isin(np.arange(10), episodes)
    for seed in range(4):
        fit = fit_log_prob(data, config=replace(QUICK, max_updates=2, folds=5), seed=seed, episodes=chosen)
        assert len(fit.folds) == 2
        assert fit.fold[episodes[0]] != fit.fold[episodes[1]]
        assert np.isfinite(fit.log_prob).all()


# Which density, and errors


def test_auto_goes_by_the_space_and_by_entries_on_the_bounds() -> None:
    assert choose_density(linear_gaussian(200), "auto") == "gaussian"
    assert choose_density(linear_gaussian(200, bound=20.0), "auto") == "gaussian"
    assert choose_density(linear_gaussian(200, bound=1.0), "auto") == "tanh-gaussian"
    with pytest.raises(ConfigurationError, match="bounded"):
        choose_density(linear_gaussian(200), "tanh-gaussian")
    with pytest.raises(ConfigurationError, match="real columns"):
        choose_density(linear_gaussian(200), "categorical")


def test_settings_are_checked() -> None:
    for wrong in ({"density": "cauchy"}, {"folds": 0}, {"hidden": ()}, {"validation": 1.0}, {"learning_rate": 0.0}):
        with pytest.raises(ConfigurationError, match=next(iter(wrong))):
            BehaviorCloning(**wrong)  # type: ignore[arg-type]


def test_one_episode_cannot_be_cross_fitted() -> None:
    data = logged(np.zeros((5, 1)), np.zeros((5, 1)), [5])
    with pytest.raises(InvalidDataError, match="folds=1"):
        fit_log_prob(data, config=QUICK, seed=0, episodes=every(data))
    fit = fit_log_prob(data, config=replace(QUICK, folds=1, max_updates=5), seed=0, episodes=every(data))
    assert np.isfinite(fit.log_prob).all()  # and constant columns divide by nothing


def test_divergence_is_named() -> None:
    data = linear_gaussian(200)
    config = replace(QUICK, learning_rate=1e30, max_updates=20, evaluate_every=1)
    with pytest.raises(TrainingError, match=r"fold 0.*Lower learning_rate"):
        fit_log_prob(data, config=config, seed=0, episodes=every(data))


# Logged and known


def test_recorded_log_probabilities_need_to_be_there() -> None:
    data = logged(np.zeros((6, 1)), np.zeros((6, 1)), [3, 3], unit=[0, 0], synthetic=[False, True])
    with pytest.raises(InvalidDataError, match=r'infos\["log_prob"\], which this dataset does not have'):
        ope.logged_log_prob(data, episodes=every(data))
    recorded = replace(data, log_prob=np.array([-1.0, -2.0, -3.0, np.nan, -1.0, np.nan]))
    values = ope.logged_log_prob(recorded, episodes=np.array([True, False]))
    assert values[:3].tolist() == [-1.0, -2.0, -3.0]
    with pytest.raises(InvalidDataError, match=r"Step 0 of episode 1 .*2 such steps.*generated"):
        ope.logged_log_prob(recorded, episodes=every(data))


def test_a_known_policy_that_cannot_have_recorded_the_data_is_refused() -> None:
    data = logged(np.zeros((2, 1)), np.array([0, 1]), [2], action_space=spaces.Discrete(2))
    half = ope.KnownBehavior(ope.UniformPolicy(spaces.Discrete(2)))
    np.testing.assert_allclose(half.log_prob(data), np.log(0.5))
    never = ope.FunctionPolicy(lambda s: 0, action_space=spaces.Discrete(2))
    with pytest.raises(InvalidDataError, match="step 1 of episode 0"):
        ope.KnownBehavior(never).log_prob(data)


@pytest.mark.shared_data
def test_the_tutors_logged_propensities(shared_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OAT_GYM_DATA", str(shared_data))
    dataset = domains.load("tutoring-smartprimer")
    data = Logged.of(dataset)
    values = ope.logged_log_prob(data, episodes=every(data))
    expected = np.concatenate([np.ravel(episode.infos["log_prob"]) for episode in dataset.iterate_episodes()])
    np.testing.assert_array_equal(values, expected)
    assert len(values) == 859
    assert values.max() <= 0.0
