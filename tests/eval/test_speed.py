"""The yardstick computes what our layers compute; otherwise a ratio of times says nothing."""

import dataclasses

import jax
import numpy as np
import pytest
from places import ROOT

from eval.performance.stopwatch import Seconds, timed
from eval.speed import clouds_and_queries, distances, interleaved, outputs, published_layers
from more2_jax.config import load_config
from more2_jax.network.prior import init_prior
from train.run.settings import TrainingRun


@pytest.fixture(scope="module")
def small():
    """Three blocks, one of every kind; two heads."""
    model = load_config(ROOT / "configs" / "tiny.yaml", TrainingRun).model
    encoder = dataclasses.replace(
        model.encoder, widths=(8, 8, 16), head_channels=8, downsample_blocks=(2,), downsample_factors=(2,)
    )
    return init_prior(published_layers(dataclasses.replace(model, encoder=encoder)), jax.random.key(0))


def test_plain_layers_say_what_ours_say(small):
    points, queries, _ = clouds_and_queries(2, 64, 16)
    coded, asked_of = (jax.jit(f, static_argnames="plain") for f in (outputs, distances))
    for cloud, asked in zip(points, queries, strict=True):
        ours, plain = (coded(small, cloud, plain=p) for p in (False, True))
        for a, b in zip(ours, plain, strict=True):
            np.testing.assert_allclose(a, b, atol=2e-5 * float(np.abs(b).max()))
        a, b = (asked_of(small, cloud, asked, plain=p) for p in (False, True))
        np.testing.assert_allclose(a, b, atol=1e-4)


def test_medians_leave_the_first_round_out():
    answers = {"a": iter([9, 1, 2, 3]), "b": iter([9, 5, 5, 50])}
    jobs = {name: (lambda it=it: Seconds((k := next(it)), 2.0 * k)) for name, it in answers.items()}
    assert interleaved(jobs, 3) == {"a": Seconds(2, 4), "b": Seconds(5, 10)}
    assert timed(lambda: np.zeros(3))().wall > 0
