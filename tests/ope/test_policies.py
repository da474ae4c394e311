"""The adapters: what they sample, the log-probabilities they give, and what they refuse."""

import subprocess
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from gymnasium import spaces
from torch.distributions import AffineTransform, TanhTransform, TransformedDistribution

from oat_gym import ope
from oat_gym.errors import ConfigurationError, DatasetNotFoundError, InvalidDataError
from oat_gym.generation.distributions import Gaussian
from oat_gym.ope._densities import tanh_gaussian_log_prob
from oat_gym.spaces import FlatSpace

BOX = spaces.Box(-1, 1, (2,))


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def integral(policy: ope.Policy, grid: np.ndarray, state: float = 0.3) -> float:
    """Return the integral of a one-dimensional policy's density over an equally spaced grid."""
    values = np.exp(policy.log_prob(np.full((len(grid), 1), state), grid[:, None]))
    return float(np.trapezoid(values, grid))


def perceptron(sizes: tuple[int, ...], seed: int = 0, **settings) -> ope.MLPPolicy:
    """Return a random policy; `sizes` are inputs, hidden layers and actions."""
    generator = rng(seed)

    def layer(inputs: int, outputs: int) -> tuple[np.ndarray, np.ndarray]:
        weight = generator.normal(size=(outputs, inputs)) / np.sqrt(inputs)
        return weight.astype(np.float32), (0.3 * generator.normal(size=outputs)).astype(np.float32)

    hidden = tuple(layer(a, b) for a, b in pairwise(sizes[:-1]))
    return ope.MLPPolicy(hidden, layer(*sizes[-2:]), layer(*sizes[-2:]), **settings)


# Tabular and other discrete policies


def test_a_table_samples_its_probabilities() -> None:
    table = np.array([[0.2, 0.5, 0.3], [0.0, 1.0, 0.0]])
    policy = ope.TabularPolicy(table)
    states = np.repeat([0, 1], 20_000)
    actions = policy.sample(states, rng=rng())
    for state in (0, 1):
        shares = np.bincount(actions[states == state], minlength=3) / 20_000
        np.testing.assert_allclose(shares, table[state], atol=4 * 0.5 / np.sqrt(20_000))
    assert policy.log_prob(np.array([0, 1]), np.array([2, 0])).tolist() == [np.log(0.3), -np.inf]
    assert policy.mean(np.array([0, 1])).tolist() == [1, 1]


def test_first_numbers_shift_states_and_actions() -> None:
    policy = ope.TabularPolicy([[0.0, 1.0], [1.0, 0.0]], first_state=5, first_action=3)
    assert policy.sample(np.array([5, 6]), rng=rng()).tolist() == [4, 3]
    assert policy.log_prob(np.array([5]), np.array([4])).tolist() == [0.0]
    with pytest.raises(InvalidDataError, match="states go from 5 to 6, got 7"):
        policy.mean(np.array([7]))
    with pytest.raises(InvalidDataError, match="actions go from 3 to 4, got 2"):
        policy.log_prob(np.array([5]), np.array([2]))


def test_an_action_of_probability_zero_is_never_drawn() -> None:
    class Largest(np.random.Generator):
        def random(self, size: int) -> np.ndarray:  # type: ignore[override]
            return np.full(size, np.nextafter(1.0, 0.0))

    table = np.full((1, 10), 0.1)
    table[0, 9] = 0.0
    policy = ope.TabularPolicy(table / table.sum())
    assert policy.sample(np.zeros(3, dtype=int), rng=Largest(np.random.PCG64())).tolist() == [8, 8, 8]


@pytest.mark.parametrize("table", [[[0.5, 0.6]], [[1.5, -0.5]], [[np.nan, 1.0]], [0.5, 0.5], np.zeros((0, 2))])
def test_a_table_must_hold_probabilities(table: object) -> None:
    with pytest.raises(ConfigurationError):
        ope.TabularPolicy(table)  # type: ignore[arg-type]


def test_a_table_is_copied() -> None:
    table = np.array([[0.5, 0.5]])
    policy = ope.TabularPolicy(table)
    table[0] = (1.0, 0.0)
    assert policy.probabilities(np.array([0])).tolist() == [[0.5, 0.5]]
    with pytest.raises(ValueError, match="read-only"):
        policy.table[0, 0] = 1.0


def test_a_table_takes_whole_numbers_only() -> None:
    with pytest.raises(InvalidDataError, match="whole numbers"):
        ope.TabularPolicy([[1.0]]).mean(np.zeros(1))


def test_epsilon_greedy_mixes_the_greedy_action_with_uniform_ones() -> None:
    space = spaces.Discrete(4, start=10)
    greedy = ope.FunctionPolicy(lambda observation: 10 + int(observation[0]), action_space=space)
    policy = ope.EpsilonGreedyPolicy(greedy, space, epsilon=0.2)
    rows = policy.probabilities(np.array([[2.0], [0.0]]))
    np.testing.assert_allclose(rows, [[0.05, 0.05, 0.85, 0.05], [0.85, 0.05, 0.05, 0.05]])
    assert policy.mean(np.array([[2.0]])).tolist() == [12]
    np.testing.assert_allclose(policy.log_prob(np.array([[2.0]]), np.array([13])), np.log(0.05))
    with pytest.raises(ConfigurationError, match="epsilon"):
        ope.EpsilonGreedyPolicy(greedy, space, epsilon=1.5)
    with pytest.raises(ConfigurationError, match="Discrete"):
        ope.UniformPolicy(BOX)  # type: ignore[arg-type]


# Functions


def test_a_function_of_one_observation_and_of_a_batch_agree() -> None:
    matrix = np.array([[1.0, 2.0], [0.5, -1.0]])
    single = ope.FunctionPolicy(lambda s: matrix @ s, action_space=BOX)
    batched = ope.FunctionPolicy(lambda s: s @ matrix.T, action_space=BOX, batched=True)
    states = rng().normal(size=(7, 2))
    np.testing.assert_allclose(single.mean(states), batched.mean(states), atol=1e-7)
    assert single.mean(states).dtype == np.float32
    assert np.abs(single.mean(states)).max() <= 1.0
    np.testing.assert_array_equal(single.sample(states, rng=rng()), single.mean(states))


def test_a_function_sees_nested_observations() -> None:
    policy = ope.FunctionPolicy(lambda s: s["mode"] % 2, action_space=spaces.Discrete(2))
    assert policy.mean({"mode": np.array([3, 4]), "x": np.zeros((2, 1))}).tolist() == [1, 0]


def test_a_stochastic_function_draws_from_the_generator_given() -> None:
    policy = ope.FunctionPolicy(lambda s: s, action_space=BOX, draw=lambda s, rng: 0.1 * rng.normal(size=2))
    states = np.zeros((5, 2))
    first, again = policy.sample(states, rng=rng(1)), policy.sample(states, rng=rng(1))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, policy.sample(states, rng=rng(2)))


def test_a_discrete_function_is_certain_and_a_continuous_one_asks_for_its_density() -> None:
    policy = ope.FunctionPolicy(lambda s: int(s[0] > 0), action_space=spaces.Discrete(2))
    assert policy.log_prob(np.array([[1.0], [1.0]]), np.array([1, 0])).tolist() == [0.0, -np.inf]
    continuous = ope.FunctionPolicy(lambda s: s, action_space=BOX)
    with pytest.raises(ConfigurationError, match="density=function"):
        continuous.log_prob(np.zeros((1, 2)), np.zeros((1, 2)))
    known = ope.FunctionPolicy(lambda s: s, action_space=BOX, density=lambda s, a: -((a - s) ** 2).sum(axis=1))
    assert known.log_prob(np.zeros((1, 2)), np.ones((1, 2))).tolist() == [-2.0]
    wrong = ope.FunctionPolicy(lambda s: s, action_space=BOX, density=lambda s, a: np.zeros((1, 2)))
    with pytest.raises(InvalidDataError, match="density must return shape"):
        wrong.log_prob(np.zeros((1, 2)), np.ones((1, 2)))


def test_a_function_that_mistakes_a_batch_for_one_observation_is_named() -> None:
    policy = ope.FunctionPolicy(lambda s: s.sum(axis=0, keepdims=True), action_space=BOX, batched=True)
    with pytest.raises(InvalidDataError, match="takes and returns batches"):
        policy.mean(np.zeros((3, 2)))


# Gaussians


def test_gaussian_densities_integrate_to_one() -> None:
    box = spaces.Box(-1, 1, (1,), dtype=np.float64)
    plain = ope.GaussianPolicy(lambda s: 2 * s, 0.5, action_space=box)
    assert integral(plain, np.linspace(-6, 6, 20_001)) == pytest.approx(1.0, abs=1e-6)
    censored = ope.GaussianPolicy(lambda s: 2 * s, 0.5, action_space=box, censored=True)
    inside = integral(censored, np.linspace(-1, 1, 20_001)[1:-1])
    atoms = np.exp(censored.log_prob(np.full((2, 1), 0.3), np.array([[-1.0], [1.0]]))).sum()
    assert inside + atoms == pytest.approx(1.0, abs=1e-3)
    assert atoms > 0.1
    beyond = censored.log_prob(np.full((1, 1), 0.3), np.array([[1.7]]))
    assert beyond == censored.log_prob(np.full((1, 1), 0.3), np.array([[1.0]]))


def test_gaussian_samples_have_its_moments_and_deterministic_ones_are_the_clipped_mean() -> None:
    policy = ope.GaussianPolicy(lambda s: np.stack([s[:, 0], 3 * s[:, 0]], axis=1), np.array([0.1, 0.2]))
    states = np.full((40_000, 1), 0.5)
    drawn = policy.sample(states, rng=rng())
    np.testing.assert_allclose(drawn.mean(axis=0), [0.5, 1.5], atol=4 * 0.2 / 200)
    np.testing.assert_allclose(drawn.std(axis=0), [0.1, 0.2], rtol=0.02)
    fixed = ope.GaussianPolicy(policy.function, policy.std, action_space=BOX, deterministic=True)
    np.testing.assert_array_equal(fixed.sample(states[:2], rng=rng()), [[0.5, 1.0], [0.5, 1.0]])
    # the density is that of the Gaussian all the same
    np.testing.assert_array_equal(fixed.log_prob(states[:2], drawn[:2]), policy.log_prob(states[:2], drawn[:2]))


def test_gaussian_refuses_what_is_no_gaussian() -> None:
    with pytest.raises(ConfigurationError, match="positive"):
        ope.GaussianPolicy(lambda s: s, 0.0)
    with pytest.raises(ConfigurationError, match="Box of floats"):
        ope.GaussianPolicy(lambda s: s, 1.0, action_space=spaces.Discrete(2))  # type: ignore[arg-type]
    with pytest.raises(InvalidDataError, match=r"shape \(3, A\)"):
        ope.GaussianPolicy(lambda s: s[:2], 1.0).mean(np.zeros((3, 1)))


def test_a_squashed_perceptron_is_a_density_inside_its_bounds() -> None:
    policy = perceptron((1, 8, 1), squash=True)
    assert integral(policy, np.linspace(-1, 1, 400_001)[1:-1]) == pytest.approx(1.0, abs=2e-3)
    drawn = policy.sample(np.full((1000, 1), 0.3), rng=rng())
    assert np.abs(drawn).max() < 1.0
    np.testing.assert_allclose(np.tanh(np.arctanh(policy.mean(np.array([[0.3]])))), policy.mean(np.array([[0.3]])))


def test_targets_and_clones_read_saturated_actions_at_one_edge() -> None:
    # the mean of the first unit and the log standard deviation are constants: mean 2, deviation 1
    one = (np.zeros((1, 1)), np.array([2.0])), (np.zeros((1, 1)), np.zeros(1))
    target = ope.MLPPolicy((), *one, action_space=spaces.Box(-1, 1, (1,)), squash=True)
    for action in (1.0, -1.0, 1 - 1e-5, 0.3):
        clone = tanh_gaussian_log_prob(Gaussian(torch.tensor([2.0]), torch.tensor([1.0])), torch.tensor([action]))
        ours = target.log_prob(np.zeros((1, 1)), np.array([[action]]))
        assert ours[0] == pytest.approx(clone.item(), rel=1e-3)


def test_a_perceptron_clips_to_the_shape_and_dtype_of_its_space() -> None:
    box = spaces.Box(-0.1, 0.1, (2, 3))
    policy = perceptron((4, 16, 6), action_space=box)
    states = rng().normal(size=(50, 4))
    for actions in (policy.mean(states), policy.sample(states, rng=rng())):
        assert actions.shape == (50, 2, 3)
        assert actions.dtype == np.float32
        assert all(action in box for action in actions)
    assert policy.log_prob(states, policy.mean(states)).shape == (50,)


def test_a_perceptron_names_what_does_not_fit() -> None:
    policy = perceptron((4, 8, 2))
    with pytest.raises(InvalidDataError, match=r"\(n, 4\)"):
        policy.mean(np.zeros((3, 5)))
    with pytest.raises(InvalidDataError, match="features="):
        policy.mean({"a": np.zeros((3, 4))})
    with pytest.raises(InvalidDataError, match="2 action columns"):
        policy.log_prob(np.zeros((3, 4)), np.zeros((3, 3)))
    with pytest.raises(ConfigurationError, match="8 outputs meets one of 9 inputs"):
        ope.MLPPolicy(policy.hidden, *(perceptron((9, 2)).mean_layer,) * 2)
    with pytest.raises(ConfigurationError, match="nonlinearity"):
        perceptron((4, 8, 2), nonlinearity="gelu")
    with pytest.raises(ConfigurationError, match="finite"):
        ope.MLPPolicy((), (np.full((1, 1), np.nan), np.zeros(1)), (np.zeros((1, 1)), np.zeros(1)))


def test_a_perceptron_reads_dict_observations_through_features() -> None:
    space = spaces.Dict(x=spaces.Box(-1, 1, (2,)), mode=spaces.Discrete(2))
    policy = perceptron((4, 8, 2), features=FlatSpace.of(space).flatten)
    batch = {"x": np.ones((3, 2), dtype=np.float32), "mode": np.array([0, 1, 1])}
    assert policy.mean(batch).shape == (3, 2)


# Torch modules


class Net(torch.nn.Module):
    """A small network with dropout, which shows whether the mode is kept."""

    def __init__(self, outputs: int) -> None:
        super().__init__()
        with torch.random.fork_rng(devices=[]):
            torch.random.default_generator.manual_seed(3)
            self.layer = torch.nn.Linear(3, outputs)

    def forward(self, states: torch.Tensor) -> torch.Tensor:
        assert states.dtype == torch.float32
        return self.layer(states)


def test_a_torch_pair_and_a_distribution_equal_the_gaussian() -> None:
    net = Net(2)
    pair = ope.TorchPolicy(lambda s: (net(s), torch.full((2,), -0.5)), BOX)
    law = ope.TorchPolicy(
        lambda s: torch.distributions.Independent(torch.distributions.Normal(net(s), np.exp(-0.5)), 1), BOX
    )
    weight, bias = (part.detach().numpy().astype(np.float64) for part in net.parameters())
    exact = ope.GaussianPolicy(lambda s: s @ weight.T + bias, np.exp(-0.5), action_space=BOX)
    states, actions = rng().normal(size=(20, 3)), rng(1).uniform(-1, 1, size=(20, 2))
    for policy in (pair, law):
        np.testing.assert_allclose(policy.log_prob(states, actions), exact.log_prob(states, actions), rtol=1e-5)
        np.testing.assert_allclose(policy.mean(states), exact.mean(states), atol=1e-6)


def test_torch_sampling_is_a_function_of_the_generator_and_leaves_the_global_state() -> None:
    net = Net(2)
    policy = ope.TorchPolicy(lambda s: (net(s), torch.zeros(2)), BOX)
    states, before = np.zeros((4, 3)), torch.random.get_rng_state()
    first = policy.sample(states, rng=rng(5))
    np.testing.assert_array_equal(first, policy.sample(states, rng=rng(5)))
    assert not np.array_equal(first, policy.sample(states, rng=rng(6)))
    assert torch.equal(before, torch.random.get_rng_state())


def test_torch_modules_keep_their_mode_and_collect_no_gradient() -> None:
    net = torch.nn.Sequential(Net(2), torch.nn.Dropout(0.5)).train()
    policy = ope.TorchCategoricalPolicy(net, spaces.Discrete(2))
    policy.probabilities(np.ones((2, 3)))
    assert net.training
    assert all(parameter.grad is None for parameter in net.parameters())


def test_torch_logits_become_probabilities() -> None:
    net = Net(3)
    policy = ope.TorchCategoricalPolicy(net, spaces.Discrete(3, start=1))
    states = rng().normal(size=(5, 3)).astype(np.float32)
    logits = net(torch.from_numpy(states)).detach().double().numpy()
    expected = np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True)
    np.testing.assert_allclose(policy.probabilities(states), expected, rtol=1e-6)
    np.testing.assert_allclose(policy.log_prob(states, np.full(5, 2)), np.log(expected[:, 1]), rtol=1e-6)
    wrapped = ope.TorchCategoricalPolicy(lambda s: torch.distributions.Categorical(logits=net(s)), spaces.Discrete(3))
    np.testing.assert_allclose(wrapped.probabilities(states), expected, rtol=1e-5)


def test_torch_policies_name_wrong_outputs() -> None:
    with pytest.raises(InvalidDataError, match="TorchCategoricalPolicy"):
        ope.TorchPolicy(Net(2), BOX).mean(np.zeros((1, 3)))
    with pytest.raises(InvalidDataError, match=r"logits of shape \(1, 2\)"):
        ope.TorchCategoricalPolicy(Net(3), spaces.Discrete(2)).probabilities(np.zeros((1, 3)))
    with pytest.raises(ConfigurationError, match="features="):
        ope.TorchPolicy(Net(2), BOX).mean({"x": np.zeros((1, 3))})
    with pytest.raises(InvalidDataError, match=r"shape \(1, 2\)"):
        ope.TorchPolicy(lambda s: (Net(3)(s), torch.zeros(3)), BOX).mean(np.zeros((1, 3)))


def squashed(
    scale: float | None = None, *, wrap: bool = True
) -> Callable[[torch.Tensor], torch.distributions.Distribution]:
    """Return SAC's policy: the tanh of a Gaussian around the state, times `scale`."""

    def law(states: torch.Tensor) -> torch.distributions.Distribution:
        base = torch.distributions.Normal(states, 0.5 * torch.ones_like(states))
        transforms = [TanhTransform(), *([] if scale is None else [AffineTransform(0.5, scale)])]
        found = TransformedDistribution(base, transforms)
        return torch.distributions.Independent(found, 1) if wrap else found

    return law


@pytest.mark.parametrize("wrap", [True, False])
@pytest.mark.parametrize(("scale", "middle"), [(None, 0.0), (2.0, 0.5), (-3.0, 0.5)])
def test_a_squashed_torch_policy_has_a_mean_and_finite_densities(
    scale: float | None, middle: float, wrap: bool
) -> None:
    size = scale or 1.0
    box = spaces.Box(middle - abs(size), middle + abs(size), (2,))
    policy = ope.TorchPolicy(squashed(scale, wrap=wrap), box)
    states = rng().normal(size=(6, 2))
    np.testing.assert_allclose(policy.mean(states), middle + size * np.tanh(states), rtol=1e-4, atol=1e-5)
    assert np.isin(policy.sample(states, rng=rng()), policy.mean(states)).sum() == 0
    at_edge = np.broadcast_to([box.low[0], box.high[1]], (6, 2))
    inner = middle + (at_edge - middle) * (1 - 1e-4)
    found = policy.log_prob(states, at_edge)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found, policy.log_prob(states, inner), rtol=1e-3)
    before = np.arctanh(np.array([0.2, -0.4]))
    expected = (
        -0.5 * ((before - states) / 0.5) ** 2 - np.log(0.5 * np.sqrt(2 * np.pi)) - np.log(1 - np.tanh(before) ** 2)
    )
    inside = policy.log_prob(states, np.tile(middle + size * np.array([0.2, -0.4]), (6, 1)))
    np.testing.assert_allclose(inside, (expected - np.log(abs(size))).sum(axis=1), rtol=1e-4)


def test_a_distribution_without_a_center_needs_its_mean_given() -> None:
    def law(states: torch.Tensor) -> torch.distributions.Distribution:
        mixing = torch.distributions.Categorical(torch.ones(len(states), 2))
        parts = torch.distributions.Independent(squashed(wrap=False)(states[:, None].expand(-1, 2, -1)), 1)
        return torch.distributions.MixtureSameFamily(mixing, parts)

    states = rng().normal(size=(4, 2))
    with pytest.raises(ConfigurationError, match=r"neither mean nor mode.*give mean_module="):
        ope.TorchPolicy(law, BOX).mean(states)
    given = ope.TorchPolicy(law, BOX, mean_module=lambda s: s.tanh(), deterministic=True)
    np.testing.assert_allclose(given.mean(states), np.tanh(states), rtol=1e-5)
    np.testing.assert_array_equal(given.sample(states, rng=rng()), given.mean(states))
    with pytest.raises(InvalidDataError, match="mean_module must return a tensor, got list"):
        ope.TorchPolicy(law, BOX, mean_module=lambda s: [0.0]).mean(states)


# DOPE's weight files


def write_dope(path: Path, seed: int = 0, **changes: object) -> dict[str, np.ndarray]:
    """Write a file of DOPE's form (5 inputs, 8-8, 3 actions); a change of None drops an array."""
    generator = rng(seed)
    sizes = {"fc0": (8, 5), "fc1": (8, 8), "last_fc": (3, 8), "last_fc_log_std": (3, 8)}
    arrays: dict[str, object] = {}
    for name, shape in sizes.items():
        arrays[f"{name}.weight"] = generator.normal(size=shape).astype(np.float32)
        arrays[f"{name}.bias"] = generator.normal(size=shape[0]).astype(np.float32)
    arrays["last_fc_log_std.weight"] = np.zeros((3, 8), dtype=np.float32)
    arrays |= {"nonlinearity": np.array("tanh"), "output_distribution": np.array("gaussian")}
    kept = {name: value for name, value in (arrays | changes).items() if value is not None}
    np.savez(path, **kept)  # type: ignore[arg-type]
    return kept  # type: ignore[return-value]


def forward(arrays: dict[str, np.ndarray], states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and log-std by the formulas of DOPE's own reader, one state at a time."""
    means, log_stds = [], []
    for state in states.astype(np.float64):
        x = state
        for name in ("fc0", "fc1"):
            x = arrays[f"{name}.weight"].astype(np.float64).dot(x) + arrays[f"{name}.bias"]
            x = np.tanh(x) if str(arrays["nonlinearity"]) == "tanh" else np.maximum(x, 0)
        means.append(arrays["last_fc.weight"].astype(np.float64).dot(x) + arrays["last_fc.bias"])
        log_stds.append(arrays["last_fc_log_std.weight"].astype(np.float64).dot(x) + arrays["last_fc_log_std.bias"])
    return np.array(means), np.array(log_stds)


def check_against_forward(policy: ope.MLPPolicy, arrays: dict[str, np.ndarray], states: np.ndarray) -> None:
    mean, log_std = forward(arrays, states)
    np.testing.assert_allclose(policy.mean(states), np.clip(mean, -1, 1), atol=2e-6)
    np.testing.assert_array_equal(policy.sample(states, rng=rng()), policy.mean(states))
    actions = rng(9).uniform(-1, 1, size=mean.shape)
    density = np.exp(-0.5 * ((actions - mean) / np.exp(log_std)) ** 2) / np.exp(log_std) / np.sqrt(2 * np.pi)
    np.testing.assert_allclose(policy.log_prob(states, actions), np.log(density).sum(axis=1), rtol=1e-6)


@pytest.mark.parametrize("nonlinearity", ["tanh", "relu"])
def test_a_dope_file_is_the_network_it_says(tmp_path: Path, nonlinearity: str) -> None:
    arrays = write_dope(tmp_path / "p.npz", nonlinearity=np.array(nonlinearity))
    check_against_forward(ope.load_dope_policy(tmp_path / "p.npz"), arrays, rng(4).normal(size=(12, 5)))
    noisy = ope.load_dope_policy(tmp_path / "p.npz", deterministic=False)
    assert not np.array_equal(noisy.sample(np.zeros((2, 5)), rng=rng()), noisy.mean(np.zeros((2, 5))))


def test_a_tanh_gaussian_dope_file_squashes(tmp_path: Path) -> None:
    arrays = write_dope(tmp_path / "p.npz", output_distribution=np.array("tanh_gaussian"))
    states = rng(4).normal(size=(12, 5))
    policy = ope.load_dope_policy(tmp_path / "p.npz")
    np.testing.assert_allclose(policy.mean(states), np.tanh(forward(arrays, states)[0]), atol=2e-6)


def test_a_folder_of_dope_files_comes_in_natural_order(tmp_path: Path) -> None:
    for number in (10, 2, 0, 1):
        write_dope(tmp_path / f"door_{number}.npz", seed=number)
    policies = ope.load_dope_policies(tmp_path)
    assert list(policies) == ["door_0", "door_1", "door_2", "door_10"]
    with pytest.raises(DatasetNotFoundError, match="no npz file"):
        ope.load_dope_policies(tmp_path / "nothing")


class Hostile:
    """An object whose unpickling runs a command."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, ...]:
        return subprocess.call, (["touch", str(self.path)],)


def test_a_pickle_inside_a_dope_file_is_not_run(tmp_path: Path) -> None:
    mark = tmp_path / "was-run"
    write_dope(tmp_path / "p.npz", **{"fc0.weight": np.array([Hostile(mark)], dtype=object)})
    with pytest.raises(InvalidDataError, match="plain arrays"):
        ope.load_dope_policy(tmp_path / "p.npz")
    assert not mark.exists()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"last_fc.bias": None}, r"lacks last_fc\.bias"),
        ({"nonlinearity": None}, "lacks nonlinearity"),
        ({"fc0.bias": None}, r"lacks fc0\.bias"),
        ({"fc0.weight": None, "fc0.bias": None}, r"lacks fc|inputs|fc0"),
        ({"nonlinearity": np.array("swish")}, "swish"),
        ({"output_distribution": np.array("cauchy")}, "cauchy"),
        ({"fc1.weight": np.zeros((8, 7), dtype=np.float32)}, "8 outputs meets one of 7 inputs"),
        ({"last_fc_log_std.weight": np.zeros((2, 8)), "last_fc_log_std.bias": np.zeros(2)}, "as many outputs"),
        ({"fc0.weight": np.full((8, 5), np.nan)}, "finite"),
        ({"fc0.weight": np.full((8, 5), "x")}, "dtype"),
        ({"fc0.bias": np.zeros((1, 8))}, "finite weights"),
    ],
)
def test_damaged_dope_files_are_refused(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    write_dope(tmp_path / "p.npz", **changes)
    with pytest.raises(InvalidDataError, match=message):
        ope.load_dope_policy(tmp_path / "p.npz")


def test_files_that_are_no_npz_are_refused(tmp_path: Path) -> None:
    write_dope(tmp_path / "p.npz")
    whole = (tmp_path / "p.npz").read_bytes()
    np.save(tmp_path / "array.npy", np.zeros(3))
    for name, content in {"cut": whole[: len(whole) // 2], "text": b"hello", "empty": b""}.items():
        (tmp_path / f"{name}.npz").write_bytes(content)
        with pytest.raises(InvalidDataError):
            ope.load_dope_policy(tmp_path / f"{name}.npz")
    with pytest.raises(InvalidDataError, match="single array"):
        ope.load_dope_policy(tmp_path / "array.npy")
    with pytest.raises(DatasetNotFoundError):
        ope.load_dope_policy(tmp_path / "absent.npz")


def test_a_dope_policy_must_fit_the_action_space_given(tmp_path: Path) -> None:
    write_dope(tmp_path / "p.npz")
    with pytest.raises(ConfigurationError, match="3 action columns"):
        ope.load_dope_policy(tmp_path / "p.npz", action_space=BOX)


@pytest.mark.shared_data
def test_the_door_policies_are_their_files(shared_data: Path) -> None:
    folder = shared_data / "robotics" / "dope_policies" / "door"
    policies = ope.load_dope_policies(folder)
    assert list(policies) == [f"door_dapg_{number}" for number in range(11)]
    states = rng().normal(size=(6, 39))
    for name, policy in policies.items():
        with np.load(folder / f"{name}.npz", allow_pickle=False) as file:
            check_against_forward(policy, dict(file), states)
