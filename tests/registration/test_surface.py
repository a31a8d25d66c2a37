"""The prior is asked only where it can decide: what is chosen, and what competes, are as if it were always asked."""

import jax
import jax.numpy as jnp
import numpy as np

from more2_jax.registration.pose_costs import ABOUT_AS_WELL, field_cost
from more2_jax.registration.surface import as_good_as, asked_in_order, choose, nearly_as_good

WEIGHT = 2.0


@jax.jit
def decided(costs, doubt):
    best = choose(costs, True, doubt)
    return best, nearly_as_good(costs + doubt, best)


asked = jax.jit(lambda costs, off: asked_in_order(lambda k: off[k], costs, WEIGHT))


def test_the_choice_and_what_competes_are_those_of_all_answers():
    rng = np.random.default_rng(0)
    spared = 0
    for _ in range(300):
        costs = jnp.asarray(rng.uniform(0.05, 0.35, 4), jnp.float32)
        off = jnp.asarray(rng.uniform(0, 0.5, 4) ** 2, jnp.float32)
        some, every = asked(costs, off), field_cost(costs, off, WEIGHT)
        spared += int(((some == 0) & (every > 0)).sum())
        for mine, expected in zip(decided(costs, some), decided(costs, every), strict=True):
            np.testing.assert_array_equal(mine, expected)
    assert spared > 100


def test_nothing_is_asked_about_what_cannot_win_nor_where_one_pose_fits_alone():
    costs, answers = [0.29, 0.10, 0.12, 0.25], [np.nan, 0.02, 0.05, np.nan]
    doubt = asked(jnp.asarray(costs), jnp.asarray(answers))
    assert costs[3] > as_good_as(as_good_as(jnp.asarray(costs[1] + WEIGHT * answers[1])))
    np.testing.assert_allclose(doubt, [0.0, 0.04, 0.1, 0.0], atol=1e-6)
    alone = jnp.asarray([0.1 + 2 * ABOUT_AS_WELL, 0.1, 0.9, 0.5])
    np.testing.assert_array_equal(asked(alone, jnp.full(4, jnp.nan)), [WEIGHT, 0.0, WEIGHT, WEIGHT])
