"""ope.evaluate: one table for many policies, estimators and seeds, with honest errors, pairs and warnings."""

import math
import warnings
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import ClassVar

import minari
import numpy as np
import pytest
from gymnasium import spaces
from minari import EpisodeData

from oat_gym import AugmentedDataset, Function, ope
from oat_gym.episodes import content_hash
from oat_gym.errors import ConfigurationError, ConformanceError, EstimationWarning, InvalidDataError
from oat_gym.ope import Estimates, Estimator, ImportanceSampling, Problem, evaluate
from tests.conftest import install_dataset

from . import mdps

GAMMA = 0.9
CHAIN = mdps.chain(3)
BEHAVIOR = np.full((4, 2), 0.5)
TABLES = {"left": np.tile([0.6, 0.4], (4, 1)), "same": BEHAVIOR, "right": np.tile([0.4, 0.6], (4, 1))}
POLICIES = {name: mdps.Table(table) for name, table in TABLES.items()}
KNOWN = mdps.Table(BEHAVIOR)
IS = ImportanceSampling()


def make(n: int = 60, *, seed: int = 0, length: int = 300, dataset_id: str = "test/chain-v0") -> minari.MinariDataset:
    logs = mdps.sample_logs(CHAIN, BEHAVIOR, n, length, np.random.default_rng(seed))
    return install_dataset(dataset_id, mdps.buffers(logs), spaces.Discrete(4), spaces.Discrete(2))


@pytest.fixture
def real() -> minari.MinariDataset:
    return make()


def louder(episode: EpisodeData, rng: np.random.Generator) -> EpisodeData:
    episode.rewards[:] += 1.0
    return episode


def copied(episode: EpisodeData, rng: np.random.Generator) -> EpisodeData:
    return episode


@dataclass(frozen=True)
class Fixed(Estimator):
    """Gives what it was told to, with replicates around it; notes what it saw."""

    value: float = 1.0
    warning: str = ""
    label: str = "fixed"
    family: ClassVar[str] = "FQE"

    @property
    def name(self) -> str:
        return self.label

    def estimate(self, problem: Problem, *, seeds: tuple[int, ...]) -> tuple[Estimates, ...]:
        if self.warning:
            warnings.warn(self.warning, EstimationWarning, stacklevel=1)
        policies, resamples = len(problem.policies), problem.resamples
        noise = (resamples[:, 0] - 1.0) / 10 * max(1.0, abs(self.value))
        used = float(problem.episodes("training").sum())
        return tuple(
            Estimates(
                np.full(policies, self.value + seed),
                np.tile(self.value + seed + noise, (policies, 1)),
                tuple({"episodes": used} for _ in range(policies)),
            )
            for seed in seeds
        )


def ask(data, estimators=IS, **settings):
    defaults = {"gamma": GAMMA, "seeds": 1, "behavior": KNOWN, "resamples": 50}
    return evaluate(data, POLICIES, estimators, **(defaults | settings))


def test_rows_are_tidy_and_the_values_are_right(real: minari.MinariDataset) -> None:
    forms = [
        ImportanceSampling(kind=kind, weighted=w) for kind in ("trajectory", "per-decision") for w in (True, False)
    ]
    result = ask(real, forms, seeds=2, resamples=400)
    assert [tuple(row) for row in result.rows] == [
        ("policy", "estimator", "seed", "value", "standard_error", "low", "high", "diagnostics")
    ] * (3 * 4 * 2)
    returns = [(e.rewards * GAMMA ** np.arange(len(e.rewards))).sum() for e in real]
    for row in result.rows:
        assert row["low"] < row["value"] < row["high"]
        truth = mdps.value(CHAIN, TABLES[row["policy"]], GAMMA)
        assert abs(row["value"] - truth) < 4 * row["standard_error"]
        if row["policy"] == "same":
            assert row["value"] == pytest.approx(np.mean(returns))
            assert row["standard_error"] == pytest.approx(np.std(returns) / math.sqrt(60), rel=0.15)


def test_the_same_question_has_the_same_answer_and_seeds_and_policies_do_not_matter_to_each_other(
    real: minari.MinariDataset,
) -> None:
    cloning = ope.BehaviorCloning(max_updates=20, folds=2, hidden=(8,))
    both = ask(real, seeds=(3, 7), behavior=cloning)
    alone = ask(real, seeds=(7,), behavior=cloning)
    expected = [row for row in both.rows if row["seed"] == 7]
    assert alone.rows == expected
    assert expected != [row | {"seed": 7} for row in both.rows if row["seed"] == 3]
    swapped = evaluate(
        real, dict(reversed(POLICIES.items())), IS, gamma=GAMMA, seeds=(7,), behavior=cloning, resamples=50
    )
    by_name = {row["policy"]: row for row in swapped.rows}
    for row in alone.rows:
        assert by_name[row["policy"]]["value"] == pytest.approx(row["value"])
    assert math.isfinite(alone.rows[0]["diagnostics"]["behavior_held_out_log_likelihood"])


def test_the_data_and_the_global_random_states_are_left_alone(real: minari.MinariDataset) -> None:
    before = content_hash(real)
    state = np.random.get_state()[1].copy()  # noqa: NPY002
    ask(real)
    assert content_hash(real) == before
    assert np.array_equal(np.random.get_state()[1], state)  # noqa: NPY002


def test_copies_of_the_data_neither_move_the_value_nor_narrow_the_interval(real: minari.MinariDataset) -> None:
    data = AugmentedDataset(real, Function(copied), factor=3, seed=0)
    alone, copies = ask(real), ask(data, use_augmented="all")
    for one, other in zip(alone.rows, copies.rows, strict=True):
        for name in ("value", "standard_error", "low", "high"):
            assert other[name] == pytest.approx(one[name], rel=1e-9)


def test_use_augmented_says_who_sees_synthetic_episodes(real: minari.MinariDataset) -> None:
    data = AugmentedDataset(real, Function(louder), count=40, seed=0)
    trained = Fixed(label="trained")

    def seen(use_augmented) -> tuple[float, bool]:
        rows = ask(data, [trained, IS], use_augmented=use_augmented, seeds=1).rows
        return rows[0]["diagnostics"]["episodes"], rows[-1]["value"] != pytest.approx(reference)

    reference = ask(real).rows[-1]["value"]
    assert seen("all") == (100.0, True)
    assert seen(None) == (100.0, False)
    assert seen("none") == (60.0, False)
    assert seen(("weights",))[0] == 60.0
    assert seen({"IS": "none"}) == (100.0, False)
    assert seen({"trained": "none"}) == (60.0, False)
    assert seen({"FQE": ("initial",), "IS": ("weights",)}) == (60.0, True)


def test_a_paired_evaluation_has_the_difference_with_its_interval(real: minari.MinariDataset) -> None:
    # every copy earns one more each step: the mean over 60 real and 60 louder ones is known
    data = AugmentedDataset(real, Function(louder), count=60, seed=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", EstimationWarning)
        result = ask(data, paired=True, use_augmented="all", resamples=400)
        unpaired = ask(real, resamples=400)
    assert [row["data"] for row in result.rows] == ["augmented"] * 3 + ["real"] * 3
    for row, alone in zip(result.rows[3:], unpaired.rows, strict=True):
        assert row["value"] == pytest.approx(alone["value"])
        assert row["low"] == pytest.approx(alone["low"])
    lengths = np.array([len(episode.rewards) for episode in real])
    extra = ((1 - GAMMA**lengths) / (1 - GAMMA)) / 2
    change = next(row for row in result.differences if row["policy"] == "same")
    assert change["difference"] == pytest.approx(extra.mean())
    assert change["standard_error"] == pytest.approx(extra.std() / math.sqrt(60), rel=0.15)
    assert change["low"] < extra.mean() < change["high"]
    with pytest.raises(ConfigurationError, match="Only a paired evaluation"):
        _ = unpaired.differences
    with pytest.raises(ConfigurationError, match="there are none"):
        ask(real, paired=True)


def test_over_seeds_adds_the_spread_of_the_seeds_to_the_error_of_the_data(real: minari.MinariDataset) -> None:
    result = ask(real, Fixed(value=-1.0), seeds=(0, 1, 2), resamples=400)
    average = result.over_seeds()[0]
    assert (average["seeds"], average["value"], average["seed_spread"]) == (3, pytest.approx(0.0), pytest.approx(1.0))
    data_error = result.rows[0]["standard_error"]
    assert average["standard_error"] == pytest.approx(math.hypot(data_error, 1 / math.sqrt(3)))
    assert average["high"] - average["low"] > 2 * 4.3 / math.sqrt(3)
    single = ask(real, Fixed(), seeds=1, resamples=400)
    assert single.over_seeds()[0]["low"] == single.rows[0]["low"]


def test_compare_and_t_test(real: minari.MinariDataset) -> None:
    truth = {name: mdps.value(CHAIN, table, GAMMA) for name, table in TABLES.items()}
    result = ask(real, resamples=400)
    for given in (truth, SimpleNamespace(values=truth, gamma=GAMMA)):
        row = result.compare(given)[0]
        assert row["mae"] == pytest.approx(np.mean([abs(r["value"] - truth[r["policy"]]) for r in result.rows]))
    with pytest.raises(ConfigurationError, match=r"truth is of gamma=0\.5"):
        result.compare(SimpleNamespace(values=truth, gamma=0.5))
    with pytest.raises(ConfigurationError, match=r"truth is of horizon=3, the estimates of horizon=None"):
        result.compare(SimpleNamespace(values=truth, gamma=GAMMA, horizon=3))
    with pytest.raises(ConfigurationError, match="truth must map policies"):
        result.compare(3.0)
    tests = {row["policy"]: row for row in result.t_test("same")}
    assert set(tests) == {"left", "right"}
    direct = ope.metrics.t_test(result.replicates("left", IS.name, 0), result.replicates("same", IS.name, 0), n=60)
    assert tests["left"]["p_value"] == direct.p_value
    with pytest.raises(ConfigurationError, match="baseline must be one of"):
        result.t_test("expert")
    with pytest.raises(ConfigurationError, match="There is no row"):
        result.replicates("left", "IS", 0)


def test_tables_for_people_and_for_pandas(real: minari.MinariDataset) -> None:
    result = ask(real)
    lines = str(result).splitlines()
    assert lines[0].split() == ["policy", "estimator", "seed", "value", "standard_error", "low", "high"]
    assert len(lines) == 4
    frame = result.to_frame()
    assert list(frame["policy"]) == list(POLICIES)
    assert (frame["diagnostics.effective_sample_size"] > 10).all()


def test_intervals_that_leave_out_training_are_marked(real: minari.MinariDataset) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", EstimationWarning)  # every episode starts in one state
        result = ask(real, [IS, ope.FQE(), ope.FQE(bootstrap=True)])
    lines = [line for line in result.table().splitlines() if line.startswith("left")]
    assert [line.endswith("*") for line in lines] == [False, True, False]
    assert "FQE(ensemble=10, bootstrap=True)" in result.table()
    assert "*" not in ask(real).table()
    covers = {row["estimator"]: row["covers_training"] for row in result.over_seeds()}
    assert covers == {IS.name: True, "FQE": False, "FQE bootstrap": True}
    for row in result.t_test("same"):  # no p-value where chance of training is left out of it
        assert row["covers_training"] == covers[row["estimator"]]
        assert math.isnan(row["p_value"]) != row["covers_training"]
    data = AugmentedDataset(real, Function(copied), count=10, seed=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", EstimationWarning)
        pair = ask(data, [IS, ope.FQE(), ope.FQE(bootstrap=True)], paired=True)
    assert {row["estimator"]: row["covers_training"] for row in pair.differences} == covers


def test_a_clone_is_held_fixed_by_resamples_and_said_to_be(real: minari.MinariDataset) -> None:
    cloning = ope.BehaviorCloning(max_updates=20, folds=2, hidden=(8,))
    result = ask(real, [IS, Fixed()], behavior=cloning)
    covers = {row["estimator"]: row["diagnostics"].get("interval_covers_training") for row in result.rows}
    assert covers == {IS.name: 0.0, "fixed": None}  # of what asks for no behaviour policy nothing is said
    assert [line.endswith("*") for line in result.table().splitlines() if line.startswith("left")] == [True, False]
    assert "a known behaviour policy (behavior=) in place of a clone" in result.table()


def test_a_behaviour_policy_that_rules_out_a_logged_action_is_refused(real: minari.MinariDataset) -> None:
    never = mdps.Table(np.tile([1.0, 0.0], (4, 1)))
    with pytest.raises(InvalidDataError, match="it cannot have recorded the data"):
        ask(real, behavior=never)

    def other(episode: EpisodeData, rng: np.random.Generator) -> EpisodeData:
        episode.actions[:] = 0
        return episode

    # an action that was generated may be impossible, as long as it is not weighted
    sure = mdps.sample_logs(CHAIN, np.tile([0.0, 1.0], (4, 1)), 20, 300, np.random.default_rng(0))
    base = install_dataset("test/sure-v0", mdps.buffers(sure), spaces.Discrete(4), spaces.Discrete(2))
    data, known = AugmentedDataset(base, Function(other), count=5, seed=0), mdps.Table(np.tile([0.0, 1.0], (4, 1)))
    rows = evaluate(data, known, IS, gamma=GAMMA, seeds=1, behavior=known, resamples=20).rows
    assert rows[0]["value"] == pytest.approx(sure.returns(GAMMA).mean())
    with pytest.raises(InvalidDataError, match=r"episode 2\d the log-probability -inf"):
        evaluate(data, known, IS, gamma=GAMMA, seeds=1, behavior=known, resamples=20, use_augmented="all")


def test_warnings_reach_the_user_and_the_rows(real: minari.MinariDataset) -> None:
    with pytest.warns(EstimationWarning, match="did not settle"):
        result = ask(real, [Fixed(warning="it did not settle"), IS])
    assert result.rows[0]["diagnostics"]["warnings"] == ("it did not settle",)
    assert result.rows[-1]["diagnostics"]["warnings"] == ()


@pytest.mark.parametrize(
    ("value", "message"),
    [(1e23, r"beyond what the rewards allow \(-1 to 10\), such as 1e\+23"), (math.nan, "not finite")],
)
def test_values_that_no_reward_can_give_are_told(real: minari.MinariDataset, value: float, message: str) -> None:
    with pytest.warns(EstimationWarning, match=message):
        result = ask(real, Fixed(value=value))
    assert len(result.rows[0]["diagnostics"]["warnings"]) == 1


def test_an_estimate_without_error_is_told(real: minari.MinariDataset) -> None:
    class Certain(Fixed):
        def estimate(self, problem: Problem, *, seeds: tuple[int, ...]) -> tuple[Estimates, ...]:
            found = super().estimate(problem, seeds=seeds)
            return tuple(replace(each, replicates=np.ones_like(each.replicates)) for each in found)

    with pytest.warns(EstimationWarning, match="3 of 3 estimates are the same in every resample"):
        ask(real, Certain())


def test_horizons_count_so_many_steps(real: minari.MinariDataset) -> None:
    same = [row for row in ask(real, horizon=2, gamma=1.0).rows if row["policy"] == "same"]
    assert same[0]["value"] == pytest.approx(np.mean([episode.rewards[:2].sum() for episode in real]))
    terminating = [row for row in ask(real, gamma=1.0).rows if row["policy"] == "same"]
    assert terminating[0]["value"] == pytest.approx(np.mean([episode.rewards.sum() for episode in real]))


def test_logged_propensities_are_the_known_policy() -> None:
    logs = mdps.sample_logs(CHAIN, BEHAVIOR, 30, 200, np.random.default_rng(0))
    buffers = [
        replace(buffer, infos={"log_prob": np.full((len(buffer.rewards) + 1, 1), math.log(0.5))})
        for buffer in mdps.buffers(logs)
    ]
    data = install_dataset("test/logged-v0", buffers, spaces.Discrete(4), spaces.Discrete(2))
    logged, known = ask(data, behavior="logged"), ask(data)
    assert [row["value"] for row in logged.rows] == pytest.approx([row["value"] for row in known.rows])


def test_the_clone_counts_clipped_actions_as_the_targets_do(walk_dataset: minari.MinariDataset) -> None:
    small = ope.BehaviorCloning(hidden=(8,), max_updates=30, folds=2)

    def values(config: ope.BehaviorCloning, *, censored: bool) -> list[float]:
        target = ope.GaussianPolicy(lambda s: s[:, :2], 0.7, walk_dataset.action_space, censored=censored)  # type: ignore[arg-type]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", EstimationWarning)
            found = evaluate(walk_dataset, target, IS, gamma=0.9, horizon=5, seeds=1, behavior=config, resamples=10)
        return [row["value"] for row in found.rows]

    for censored, kind in ((True, "censored"), (False, "gaussian")):
        left_to_us = values(small, censored=censored)
        assert left_to_us == values(replace(small, density=kind), censored=censored)
        assert left_to_us != values(replace(small, density="mixture"), censored=censored)


def test_ids_lists_and_single_policies_are_taken(real: minari.MinariDataset) -> None:
    by_id = evaluate("test/chain-v0", KNOWN, IS, gamma=GAMMA, seeds=1, behavior=KNOWN, resamples=20)
    assert [row["policy"] for row in by_id.rows] == ["policy-0"]
    pair = evaluate(real, [KNOWN, KNOWN], [IS], gamma=GAMMA, seeds=[5], behavior=KNOWN, resamples=20)
    assert [(row["policy"], row["seed"]) for row in pair.rows] == [("policy-0", 5), ("policy-1", 5)]


def test_given_initial_states_are_handed_on(real: minari.MinariDataset) -> None:
    with pytest.warns(EstimationWarning, match="not from those given as initial_states"):
        ask(real, initial_states=np.array([0, 1, 1]))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"gamma": 0.0}, "gamma must be above 0 and at most 1, got 0.0"),
        ({"gamma": 1.5}, "gamma must be above 0"),
        ({"horizon": 0}, "horizon must be a number of steps"),
        ({"horizon": 2.5}, "horizon must be a number of steps"),
        ({"seeds": 0}, "positive number of seeds"),
        ({"seeds": (1, 1)}, "different seeds"),
        ({"seeds": (-1,)}, "non-negative integer"),
        ({"behavior": "cloned"}, "'clone', 'logged'"),
        ({"behavior": lambda s: s}, "'clone', 'logged'"),
        ({"use_augmented": "some"}, "use_augmented must be None, 'all'"),
        ({"use_augmented": ("test",)}, "a tuple out of behavior, initial, training, weights"),
        ({"use_augmented": {"FQE": "all"}}, "use_augmented names FQE"),
        ({"interval": "bca"}, "interval must be one of bootstrap, percentile, normal"),
        ({"confidence": 95}, "confidence must lie between 0 and 1"),
        ({"resamples": 1}, "resamples must be a whole number"),
        ({"initial_states": np.zeros((3, 2))}, r"shape \(M, \).*got shape \(3, 2\)"),
        ({"initial_states": np.array(1)}, "A single state needs one more axis"),
        ({"initial_states": np.zeros(0)}, "at least one observation"),
        ({"estimators": []}, "at least one"),
        ({"estimators": ImportanceSampling}, "instances such as"),
        ({"estimators": [IS, IS]}, "IS per-decision weighted is there more than once"),
    ],
)
def test_settings_that_cannot_work_are_refused(real: minari.MinariDataset, settings: dict, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        ask(real, **settings)


def test_undiscounted_values_need_an_end() -> None:
    cut = make(12, length=2, dataset_id="test/cut-v0")
    with pytest.raises(ConfigurationError, match="gamma=1 without a horizon has no finite value here"):
        ask(cut, gamma=1.0)
    with pytest.raises(ConfigurationError, match="data must be a Minari dataset"):
        ask(3)


def test_an_estimator_of_wrong_shapes_is_named(real: minari.MinariDataset) -> None:
    class Wrong(Fixed):
        def estimate(self, problem: Problem, *, seeds: tuple[int, ...]) -> tuple[Estimates, ...]:
            return (Estimates(np.zeros(2), np.zeros((2, 3)), ({}, {})),) * len(seeds)

    with pytest.raises(ConformanceError, match="fixed returned values, replicates and diagnostics of shapes"):
        ask(real, Wrong())


# --- what policies do with the data's actions ------------------------------------------------------------------------


def never(*_: object) -> float:
    raise AssertionError("nothing is fitted for a policy that acts elsewhere")


def function(space: spaces.Space, action: object) -> ope.FunctionPolicy:
    return ope.FunctionPolicy(lambda state: action, action_space=space)


BOX2 = spaces.Box(-1, 1, (2,))


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (function(BOX2, np.zeros(2)), r"'p' acts in Box.*\(2,\).*the data in Discrete\(2\)"),
        (function(spaces.Discrete(3), 0), r"'p' acts in Discrete\(3\), the data in Discrete\(2\)"),
        (function(spaces.Discrete(2, start=1), 1), r"'p' acts in Discrete\(2, start=1\), the data in"),
        (function(spaces.MultiDiscrete([2]), [0]), r"'p' acts in MultiDiscrete\(\[2\]\), the data in"),
        (ope.UniformPolicy(spaces.Discrete(3)), r"'p' acts in Discrete\(3\)"),
    ],
)
def test_policies_over_other_actions_are_refused(real: minari.MinariDataset, policy: ope.Policy, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        evaluate(real, {"p": policy}, Fixed(), gamma=GAMMA, seeds=1, progress=never)


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (ope.GaussianPolicy(lambda s: np.zeros((len(s), 2)), 1.0), r"'p' returned actions of shape \(8, 2\) for 8"),
        (ope.GaussianPolicy(lambda s: np.zeros((len(s), 1)), 1.0), "'p' returned the action .*, which is not in Disc"),
        (ope.TabularPolicy(np.full((4, 3), 1 / 3)), r"'p' returned probabilities of shape \(8, 3\) for 8"),
        (ope.TabularPolicy(np.full((4, 2), 0.5), first_action=4), "'p' returned the action [45], which is not in Disc"),
    ],
)
def test_actions_of_policies_without_a_space_are_looked_at(
    real: minari.MinariDataset, policy: ope.Policy, message: str
) -> None:
    with pytest.raises(InvalidDataError, match=message):
        evaluate(real, {"p": policy}, Fixed(), gamma=GAMMA, seeds=1, progress=never)


def test_continuous_policies_fit_the_data_in_shape_and_not_in_bounds(walk_dataset: minari.MinariDataset) -> None:
    def ask_of(policy: ope.Policy) -> int:
        return len(evaluate(walk_dataset, {"p": policy}, Fixed(value=-1.0), gamma=GAMMA, seeds=1, resamples=5).rows)

    wider = spaces.Box(-9, 9, (2,), np.float64)
    for fine in (function(wider, np.zeros(2)), ope.GaussianPolicy(lambda s: s[:, :2], 0.1)):
        assert ask_of(fine) == 1
    with pytest.raises(ConfigurationError, match=r"'p' acts in Box.*\(1,\).*the data in Box.*\(2,\)"):
        ask_of(function(spaces.Box(-1, 1, (1,)), np.zeros(1)))
    with pytest.raises(ConfigurationError, match=r"'p' acts in Discrete\(2\), the data in Box"):
        ask_of(function(spaces.Discrete(2), 0))
    with pytest.raises(InvalidDataError, match=r"returned actions of shape \(8, 1\) for 8.*\(8, 2\) is expected"):
        ask_of(ope.GaussianPolicy(lambda s: s[:, :1], 0.1))
    with pytest.raises(InvalidDataError, match="'p' returned NaN actions"):
        ask_of(ope.GaussianPolicy(lambda s: np.full((len(s), 2), np.nan), 0.1))


def test_nan_actions_are_no_divergence(walk_dataset: minari.MinariDataset) -> None:
    broken = function(walk_dataset.action_space, np.full(2, np.nan))
    for estimator in (ope.FQE(updates=10**9), ope.DICE(updates=10**9), ope.FQE(approximation="linear")):
        with pytest.raises(InvalidDataError, match="'p' returned NaN actions"):
            evaluate(walk_dataset, {"p": broken}, estimator, gamma=GAMMA, seeds=1, resamples=5)


def test_a_policy_that_only_knows_probabilities_is_let_pass(real: minari.MinariDataset) -> None:
    class Known(mdps.Table):
        def sample(self, observations, *, rng):
            raise NotImplementedError

    rows = evaluate(real, Known(BEHAVIOR), IS, gamma=GAMMA, seeds=1, behavior=KNOWN, resamples=5).rows
    assert rows[0]["value"] == pytest.approx(np.mean([(e.rewards * GAMMA ** np.arange(len(e))).sum() for e in real]))


# --- data that Minari combined ---------------------------------------------------------------------------------------


def test_combined_augmented_data_is_warned_of_and_combined_real_data_is_not(real: minari.MinariDataset) -> None:
    saved = AugmentedDataset(real, Function(copied), factor=3, seed=0).save("test/augmented-v0")
    other = make(10, seed=1, dataset_id="test/other-v0")
    mixed = minari.combine_datasets([saved, other], "test/mixed-v0")
    with pytest.warns(EstimationWarning, match=r"combined from augmented datasets \(test/augmented-v0\)"):
        assert ope.Logged.of(mixed).n_units == 190  # copies count as real
    both = minari.combine_datasets([real, other], "test/both-v0")
    assert ope.Logged.of(both).n_units == 70
    again = AugmentedDataset(both, Function(copied), factor=2, seed=0).save("test/again-v0")
    assert ope.Logged.of(again).n_units == 70
    minari.delete_dataset("test/other-v0")
    assert ope.Logged.of(both).n_units == 70  # of a part that is gone nothing is said


def test_estimates_are_kept_within_what_policies_can_earn(real: minari.MinariDataset) -> None:
    """Copies that pay more move one side beyond the range: what is left of the difference is what the range allows."""
    plain = ask(AugmentedDataset(real, Function(louder), factor=2), paired=True, use_augmented="all", resamples=50)
    values = {row["data"]: row["value"] for row in plain.rows if row["policy"] == "same"}
    low, high = values["real"] - 100.0, (values["real"] + values["augmented"]) / 2
    moved = plain.within(low, high)
    assert all(low <= row[name] <= high for row in moved.rows for name in ("value", "low", "high"))
    for row, before in zip(moved.rows, plain.rows, strict=True):
        assert row["diagnostics"]["outside_range"] == pytest.approx(before["value"] - row["value"])
        assert row["standard_error"] == before["standard_error"]
    difference = next(row for row in moved.differences if row["policy"] == "same")["difference"]
    assert difference == pytest.approx(high - values["real"])
    assert plain.within(-1e9, 1e9).compare(dict.fromkeys(POLICIES, 0.0)) == plain.compare(dict.fromkeys(POLICIES, 0.0))
    for wrong in ((1.0, 1.0), (0.0, math.inf)):
        with pytest.raises(ConfigurationError, match="low < high"):
            plain.within(*wrong)
