"""Distributions against torch.distributions and against frequencies."""

import numpy as np
import pytest
import torch
from torch import distributions as td

from oat_gym.generation.distributions import (
    Gaussian,
    MixedHead,
    bernoulli_log_prob,
    censored_log_prob,
    gaussian_kl,
    gaussian_log_prob,
)
from oat_gym.spaces import Layout


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(3)


def random_gaussian(generator, *shape):
    mean = torch.randn(shape, generator=generator, dtype=torch.float64)
    return Gaussian(mean, torch.rand(shape, generator=generator, dtype=torch.float64) + 0.1)


def test_kl_is_the_closed_form(generator):
    q, p = random_gaussian(generator, 7, 4), random_gaussian(generator, 7, 4)
    expected = td.kl_divergence(td.Normal(*q), td.Normal(*p)).sum(-1)
    torch.testing.assert_close(gaussian_kl(q, p), expected)
    assert torch.allclose(gaussian_kl(q, q), torch.zeros(7, dtype=torch.float64))


def test_gaussian_log_density(generator):
    p = random_gaussian(generator, 5, 3)
    x = torch.randn((5, 3), generator=generator, dtype=torch.float64)
    torch.testing.assert_close(gaussian_log_prob(p, x), td.Normal(*p).log_prob(x))


def test_bernoulli_log_prob():
    logit, x = torch.tensor([-3.0, 0.5, 40.0]), torch.tensor([1.0, 0.0, 1.0])
    torch.testing.assert_close(bernoulli_log_prob(logit, x), td.Bernoulli(logits=logit).log_prob(x))


def test_censored_gaussian_integrates_to_one():
    p = Gaussian(torch.tensor([0.7], dtype=torch.float64), torch.tensor([0.5], dtype=torch.float64))
    low, high = torch.tensor([-1.0], dtype=torch.float64), torch.tensor([1.0], dtype=torch.float64)
    grid = torch.linspace(-1, 1, 20001, dtype=torch.float64)[1:-1, None]
    inside = torch.trapezoid(censored_log_prob(p, grid, low, high).exp()[:, 0], grid[:, 0])
    bounds = censored_log_prob(p, low, low, high).exp() + censored_log_prob(p, high, low, high).exp()
    assert float(inside + bounds) == pytest.approx(1.0, abs=1e-4)
    assert censored_log_prob(p, high + 3, low, high) == censored_log_prob(p, high, low, high)


@pytest.mark.parametrize("bound", [float("inf"), float(torch.finfo(torch.float32).max), 1e19, 1e18, 1e7])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_bounds_that_mean_none_censor_nothing_and_keep_gradients_finite(generator, bound, dtype):
    p = random_gaussian(generator, 4, 2)
    mean, scale = p.mean.to(dtype, copy=True).requires_grad_(), p.scale.to(dtype)
    bounds = torch.full((2,), bound, dtype=dtype)
    x = torch.randn((4, 2), generator=generator, dtype=torch.float64).to(dtype)
    value = censored_log_prob(Gaussian(mean, scale), x, -bounds, bounds)
    torch.testing.assert_close(value, td.Normal(mean, scale).log_prob(x))
    value.sum().backward()
    assert torch.isfinite(mean.grad).all()


def test_mixed_head_log_prob_is_the_sum_of_its_parts(generator):
    layout = Layout(8, (0, 3), ((1, 3), (4, 8)))
    head = MixedHead(layout, 0.1)
    assert head.width == 2 * 2 + 2 + 4
    output = torch.randn((6, head.width), generator=generator)
    x = torch.zeros(6, 8)
    x[:, [0, 3]] = torch.randn((6, 2), generator=generator)
    first, second = torch.arange(6) % 2, torch.arange(6) % 4
    x[torch.arange(6), 1 + first] = 1.0
    x[torch.arange(6), 4 + second] = 1.0
    scale = torch.nn.functional.softplus(output[:, 2:4]) + 0.1
    expected = td.Normal(output[:, :2], scale).log_prob(x[:, [0, 3]]).sum(-1)
    expected = expected + td.Categorical(logits=output[:, 4:6]).log_prob(first)
    expected = expected + td.Categorical(logits=output[:, 6:]).log_prob(second)
    torch.testing.assert_close(head.log_prob(output, x), expected)


def test_mixed_head_samples_have_the_right_frequencies(generator):
    layout = Layout(6, (5,), ((0, 2), (2, 5)))
    head = MixedHead(layout, 0.1)
    output = torch.tensor([1.0, 0.0, 0.0, 1.0, 2.0, 0.0, -1.0]).expand(20000, 7)
    rows = head.sample(output, generator)
    assert torch.equal(rows[:, :2].sum(1), torch.ones(20000))
    np.testing.assert_allclose(rows[:, :2].mean(0), torch.softmax(output[0, 2:4], 0), atol=0.02)
    np.testing.assert_allclose(rows[:, 2:5].mean(0), torch.softmax(output[0, 4:], 0), atol=0.02)
    assert float(rows[:, 5].mean()) == pytest.approx(1.0, abs=0.03)
    assert float(rows[:, 5].std()) == pytest.approx(
        float(torch.nn.functional.softplus(torch.tensor(0.0))) + 0.1, rel=0.03
    )
    assert head.sample(output[:1], None)[0].tolist() == [0, 1, 1, 0, 0, 1]
