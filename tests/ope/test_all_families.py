"""All five families in one call of evaluate: continuous data, augmented, saved, viewed; and logged propensities."""

import warnings
from pathlib import Path

import minari
import numpy as np
import pytest
import torch
from minari import EpisodeData

from oat_gym import AugmentedDataset, Function, domains, ope
from oat_gym.checks import check_estimator
from oat_gym.errors import EstimationWarning, InvalidDataError
from oat_gym.ope import Result

FQE = ope.FQE(updates=40, hidden=(16,))
FAMILIES = [
    FQE,
    ope.ImportanceSampling(clip=(-6.0, 2.0)),
    ope.DICE(updates=40, hidden=(16,)),
    ope.DoublyRobust(q=FQE),
    ope.ModelBased(updates=40, hidden=(16,), ensemble=2),
]
CLONING = ope.BehaviorCloning(max_updates=40, hidden=(16,), folds=2)


def louder(episode: EpisodeData, rng: np.random.Generator) -> EpisodeData:
    episode.rewards[:] += 1.0
    return episode


def ask(data: minari.MinariDataset, **settings) -> Result:
    policy = ope.FunctionPolicy(
        lambda state: np.array([0.1, -0.1]),
        action_space=data.action_space,
        density=lambda s, a: -50.0 * np.square(a - np.array([0.1, -0.1])).sum(axis=1),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", EstimationWarning)  # few updates
        return ope.evaluate(
            data, policy, FAMILIES, gamma=0.95, horizon=10, seeds=1, behavior=CLONING, resamples=30, **settings
        )


def values(result: Result, data: str | None = None) -> dict[str, float]:
    return {row["estimator"]: row["value"] for row in result.rows if row.get("data") == data}


def test_augmented_saved_and_viewed_data(walk_dataset: minari.MinariDataset) -> None:
    data = AugmentedDataset(walk_dataset, Function(louder), factor=3, seed=0)
    alone, pair = values(ask(walk_dataset)), ask(data, paired=True)
    assert values(pair, "real") == pytest.approx(alone, rel=1e-6)
    change = {row["estimator"]: row["difference"] for row in pair.differences}
    assert change[FAMILIES[1].name] == 0.0  # weights are real by default
    louder_by = 2 / 3 * (1 - 0.95**10) / 0.05  # two of three episodes earn one more a step
    for family in (FAMILIES[0], FAMILIES[2], FAMILIES[4]):
        assert change[family.name] == pytest.approx(louder_by, rel=0.25)
    everything = {
        row["estimator"]: row["difference"] for row in ask(data, paired=True, use_augmented="all").differences
    }
    assert everything[FAMILIES[1].name] == pytest.approx(louder_by, rel=0.01)  # cloned anew, on all
    data.save("test/louder-v0")
    whole = values(ask(data))
    assert values(ask(minari.load_dataset("test/louder-v0"))) == pytest.approx(whole)
    half = data.filter_episodes(lambda episode: episode.id % 12 < 6)
    assert len(half) == 18
    assert set(values(ask(half))) == set(whole)
    with pytest.raises(InvalidDataError, match="which is not in this view"):
        ask(data.filter_episodes(lambda episode: episode.id != 3))


CONTRACT = [
    ope.FQE(),
    ope.FQE(bootstrap=True),
    ope.FQE(approximation="linear"),
    ope.DICE(),
    ope.ModelBased(),
    ope.DoublyRobust(),
    ope.DoublyRobust(kind="dr"),
    ope.DoublyRobust(kind="magic"),
    ope.ModelBased(kind="ensemble", updates=200, hidden=(16,), ensemble=1, learning_rate=6e-3, tolerance=0.02),
]


@pytest.mark.parametrize("estimator", CONTRACT, ids=lambda estimator: estimator.name)
def test_every_family_keeps_the_contract(estimator: ope.Estimator) -> None:
    assert not check_estimator(estimator, tolerance=0.15).failed


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_every_family_runs_on_a_gpu(walk_dataset: minari.MinariDataset) -> None:
    on_cpu, on_gpu = (ask(walk_dataset, device=device) for device in ("cpu", "cuda"))
    assert values(on_gpu) == pytest.approx(values(on_cpu), rel=0.05)


@pytest.mark.shared_data
def test_logged_propensities_of_the_tutor_give_its_mean_return(shared_data: Path) -> None:
    data = domains.load("tutoring-smartprimer")
    logged = ope.Logged.of(data)

    class Tutor:
        """The policy that recorded the log, known by its propensities only."""

        def log_prob(self, observations, actions):
            return logged.log_prob

        def sample(self, observations, *, rng):
            raise NotImplementedError

        def mean(self, observations):
            raise NotImplementedError

    forms = [ope.ImportanceSampling(kind=k, weighted=w) for k in ("trajectory", "per-decision") for w in (True, False)]
    result = ope.evaluate(data, Tutor(), forms, gamma=1.0, seeds=1, behavior="logged", resamples=20)
    mean = np.mean([episode.rewards.sum() for episode in data])
    assert [row["value"] for row in result.rows] == pytest.approx([mean] * 4)
