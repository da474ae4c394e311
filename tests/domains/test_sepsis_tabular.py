"""The finite sepsis models: exact values against published ones and against roll-outs, and logs of a known policy."""

import doctest

import numpy as np
import pytest

from oat_gym.checks import check_dataset
from oat_gym.domains import _tabular, _tabular_view, sepsis_tabular
from oat_gym.domains._tabular import TabularMDP, mixture, optimal_policy, policy_value, sample_episodes, state_values
from oat_gym.errors import ConfigurationError, DatasetNotFoundError, InvalidDataError

TITLES = ("icu-sepsis", "icu-sepsis-features", "sepsis-mdp", "sepsis-mdp-features")


def random_mdp(seed: int = 0, *, states: int = 7, actions: int = 3) -> TabularMDP:
    rng = np.random.default_rng(seed)
    table = rng.dirichlet(np.full(states, 0.3), size=(states, actions))
    table[table < 0.02] = 0.0
    table /= table.sum(axis=2, keepdims=True)
    terminal = np.arange(states) >= states - 2
    initial = np.where(terminal, 0.0, rng.random(states))
    return TabularMDP.from_dense(table, rng.normal(size=states), initial / initial.sum(), terminal)


def random_policy(mdp: TabularMDP, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).dirichlet(np.ones(mdp.n_actions), size=mdp.n_states)


@pytest.mark.parametrize("module", [_tabular, _tabular_view])
def test_examples_in_docstrings(module):
    assert doctest.testmod(module, extraglobs={"np": np}).failed == 0


@pytest.mark.parametrize("gamma", [0.5, 0.95, 1.0])
def test_exact_values_solve_bellmans_equation_and_are_the_limit_of_long_horizons(gamma):
    mdp = random_mdp()
    policy = random_policy(mdp, 1)
    values = state_values(mdp, policy, gamma=gamma)
    backup = (policy * (mdp.expected_reward + gamma * mdp.expect(values))).sum(axis=1)
    np.testing.assert_allclose(values, backup, atol=1e-12)
    np.testing.assert_allclose(values, state_values(mdp, policy, gamma=gamma, horizon=2000), atol=1e-9)
    assert (values[mdp.terminal] == 0).all()


def test_exact_values_agree_with_roll_outs():
    mdp = random_mdp(3)
    policy = random_policy(mdp, 2)
    episodes = sample_episodes(mdp, policy, episodes=2000, horizon=500, seed=0, observe=lambda states: states)
    returns = np.array([e.rewards @ 0.9 ** np.arange(len(e.rewards)) for e in episodes])
    error = returns.std(ddof=1) / np.sqrt(len(returns))
    assert abs(returns.mean() - policy_value(mdp, policy, gamma=0.9)) < 4 * error
    assert error < 0.1


def test_transitions_are_drawn_with_their_probabilities():
    mdp = random_mdp(5)
    n = 20_000
    for pair in (0, 7, 13):
        state, action = divmod(pair, mdp.n_actions)
        drawn = mdp.step(np.full(n, state), np.full(n, action), np.random.default_rng(pair))
        expected = np.zeros(mdp.n_states)
        rows = mdp.source == pair
        expected[mdp.target[rows]] = mdp.probability[rows]
        seen = np.bincount(drawn, minlength=mdp.n_states) / n
        np.testing.assert_allclose(seen, expected, atol=4 * np.sqrt(0.25 / n))
        assert not seen[expected == 0].any()


def test_no_policy_is_better_than_the_optimal_one_nor_worse_than_the_worst():
    mdp = random_mdp(8)
    best, worst = (state_values(mdp, optimal_policy(mdp, gamma=0.9, sign=sign), gamma=0.9) for sign in (1.0, -1.0))
    for seed in range(30):
        values = state_values(mdp, random_policy(mdp, seed), gamma=0.9)
        assert (values <= best + 1e-9).all()
        assert (values >= worst - 1e-9).all()


def test_broken_processes_are_refused():
    good = random_mdp()
    parts = {name: getattr(good, name) for name in ("n_actions", "source", "target", "reward", "initial", "terminal")}
    with pytest.raises(InvalidDataError, match="sum to 1"):
        TabularMDP(probability=good.probability * 1.1, **parts)
    with pytest.raises(InvalidDataError, match="Initial"):
        TabularMDP(probability=good.probability, **(parts | {"initial": good.initial[::-1]}))
    with pytest.raises(InvalidDataError, match="order"):
        TabularMDP(probability=good.probability, **(parts | {"source": good.source[::-1]}))
    with pytest.raises(ConfigurationError, match="gamma"):
        policy_value(good, random_policy(good, 0), gamma=1.5)


@pytest.mark.shared_data
def test_icu_sepsis_has_the_published_values(shared_data):
    model = sepsis_tabular.sepsis_model("icu-sepsis", shared_data)
    value = {name: policy_value(model.mdp, table, gamma=1.0) for name, table in model.targets.items()}
    assert value["clinicians"] == pytest.approx(0.782, abs=5e-4)
    assert value["uniform"] == pytest.approx(0.780, abs=5e-4)
    assert value["worst"] < value["worst-clinicians"] < value["clinicians"] < value["optimal"] < 1


@pytest.mark.shared_data
def test_no_observation_is_taken_for_an_end(shared_data):
    view = sepsis_tabular.sepsis_model("icu-sepsis", shared_data).view(True)
    everything = np.asarray(view.observe(np.arange(716)))
    assert not everything[713:].any(), "ends show as zeros, the average patient"
    np.testing.assert_array_equal(view.recover(everything[:713]), np.arange(713))
    assert (view.recover(np.concatenate([everything, 0.5 * everything])) < 713).all()


@pytest.mark.shared_data
def test_the_simulators_rules_say_where_the_published_process_is_rewarded(shared_data):
    with np.load(shared_data / sepsis_tabular.MDP_FILE, allow_pickle=False) as file:
        index, values = file["r_idx"], file["r_val"]
    published = np.zeros(1440)
    chosen = index[:, (index[1] == 0) & (index[2] == 0)]  # rewards depend on the next state only
    published[chosen[0].astype(int) * 720 + chosen[3]] = values[(index[1] == 0) & (index[2] == 0)]
    model = sepsis_tabular.sepsis_model("sepsis-mdp", shared_data)
    np.testing.assert_array_equal(model.mdp.reward, published)
    assert model.mdp.initial[:720].sum() == pytest.approx(0.8)


@pytest.mark.shared_data
@pytest.mark.parametrize("title", TITLES)
def test_logs_record_the_behaviour_policy_and_pass_the_checks(title, shared_data, monkeypatch):
    monkeypatch.setenv("OAT_GYM_DATA", str(shared_data))
    monkeypatch.setattr(sepsis_tabular, "_PATIENTS", 25)
    data, task = sepsis_tabular.DATASETS[title](), sepsis_tabular.TASKS[title]
    if "features" in title:  # the same episodes twice
        check_dataset(data)
    name, features = sepsis_tabular._TITLES[title]
    model = sepsis_tabular.sepsis_model(name)
    view = model.view(features)
    behavior = view.policy(model.behavior)
    for episode in data.iterate_episodes(range(20)):
        seen = episode.observations
        np.testing.assert_array_equal(view.recover(seen)[:-1], episode.infos["state"])
        np.testing.assert_allclose(behavior.log_prob(seen[:-1], episode.actions), episode.infos["log_prob"])
        assert episode.terminations[-1] != episode.truncations[-1]
    truth, targets = task.truth(task.gamma), task.policies()
    assert list(truth.values) == list(targets)
    assert truth.episodes == 0
    starts = task.initial_states(7, 0)
    assert all(policy.probabilities(starts).shape == (7, model.mdp.n_actions) for policy in targets.values())


@pytest.mark.shared_data
@pytest.mark.parametrize("name", ["icu-sepsis", "sepsis-mdp"])
def test_importance_weights_of_the_log_find_the_exact_value(name, shared_data):
    model = sepsis_tabular.sepsis_model(name, shared_data)
    near = mixture(model.targets["optimal"], model.behavior, 0.1)
    episodes = sample_episodes(
        model.mdp, model.behavior, episodes=1500, horizon=40, seed=1, observe=lambda states: states
    )
    weighted = np.array(
        [
            np.exp(np.cumsum(np.log(near[e.infos["state"], e.actions]) - e.infos["log_prob"]))
            @ (e.rewards * 0.9 ** np.arange(len(e.rewards)))
            for e in episodes
        ]
    )
    error = weighted.std(ddof=1) / np.sqrt(len(weighted))
    assert abs(weighted.mean() - policy_value(model.mdp, near, gamma=0.9, horizon=40)) < 4 * error


@pytest.mark.shared_data
def test_a_log_is_built_again_to_the_same_bytes(shared_data, tmp_path, monkeypatch):
    content = []
    for name in "ab":
        monkeypatch.setenv("OAT_GYM_CACHE", str(tmp_path / name))
        folder = sepsis_tabular.sepsis_log("sepsis-mdp", features=True, path=shared_data).storage.data_path
        content.append([(folder / file).read_bytes() for file in ("main_data.hdf5", "metadata.json")])
    assert content[0] == content[1]


def test_missing_and_foreign_files_say_what_to_do(tmp_path, monkeypatch):
    monkeypatch.setenv("OAT_GYM_DATA", str(tmp_path))
    monkeypatch.setattr(sepsis_tabular, "_installed", lambda *_: None)
    for name, hint in (("icu-sepsis", "pip install icu-sepsis"), ("sepsis-mdp", "clinicalml/gumbel-max-scm")):
        with pytest.raises(DatasetNotFoundError, match=hint):
            sepsis_tabular.sepsis_model(name)
    np.savez(tmp_path / "dynamics.npz", tx_mat=np.zeros(1))
    with pytest.raises(InvalidDataError, match="lacks the arrays"):
        sepsis_tabular.sepsis_model("icu-sepsis", tmp_path / "dynamics.npz")


def test_the_nearest_centre_stands_for_a_generated_observation():
    points = np.random.default_rng(0).normal(size=(40, 5))
    view = _tabular_view.centres(points)
    near = points + 1e-3
    np.testing.assert_array_equal(view.recover(near), np.arange(40))
    table = np.random.default_rng(1).dirichlet(np.ones(3), size=40)
    np.testing.assert_allclose(view.policy(table).probabilities(near), table)


def test_an_unknown_model_is_refused_with_the_names():
    with pytest.raises(ConfigurationError, match="are icu-sepsis, sepsis-mdp; got 'icu'"):
        sepsis_tabular.sepsis_model("icu")
