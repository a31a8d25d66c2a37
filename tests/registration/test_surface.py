"""The prior is asked only where it can decide: what is chosen, and what competes, are as if it were always asked."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from more2_jax.registration.pose_costs import ABOUT_AS_WELL, field_cost
from more2_jax.registration.surface import (
    IN_PLACE,
    NOT_TURNED_DEG,
    TURNED_OFFSET,
    TURNED_RATIO,
    as_good_as,
    asked_in_order,
    choose,
    motion_since,
    nearly_as_good,
    simplest,
    simply,
    turned_in_place,
)

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


CENTER = jnp.asarray([0.4, -0.3, 0.2])
COSTS = jnp.asarray([0.1, 0.2, 0.3])


def about_center(turn_deg, shift):
    """Turned about the vertical through the center, then shifted along x."""
    R = jaxlie.SO3.from_z_radians(jnp.deg2rad(turn_deg))
    t = CENTER - R @ CENTER + jnp.asarray([shift, 0.0, 0.0])
    return jaxlie.SE3.from_rotation_and_translation(R, t)


@jax.jit
def charged(poses, stayed, costs):
    return turned_in_place(motion_since(stayed, poses, CENTER), costs)


def cost_of(stayed, *motions):
    poses = [stayed @ m for m in motions]
    poses = jaxlie.SE3(jnp.stack([T.wxyz_xyz for T in poses]))
    return charged(poses, stayed, COSTS[: len(motions)])


def test_only_a_turn_where_a_thing_stood_has_to_fit_better_in_whatever_frame():
    rng = np.random.default_rng(0)
    for _ in range(5):
        R = jaxlie.SO3(jnp.asarray(rng.normal(size=4))).normalize()
        stayed = jaxlie.SE3.from_rotation_and_translation(R, jnp.asarray(rng.normal(size=3)))
        turned = [about_center(d, 0.5 * IN_PLACE) for d in (2 * NOT_TURNED_DEG, 180.0, -90.0)]
        expected = (TURNED_RATIO - 1) * COSTS + TURNED_OFFSET
        np.testing.assert_allclose(cost_of(stayed, *turned), expected, rtol=1e-5)
        others = (
            about_center(0.0, 0.0),
            about_center(0.5 * NOT_TURNED_DEG, 0.0),
            about_center(90.0, 1.2 * IN_PLACE),
        )
        np.testing.assert_array_equal(cost_of(stayed, *others), 0.0)


def test_what_looks_alike_turned_round_is_taken_to_stand_as_it_stood():
    """A half turn that fits a little better, by noise, and one that fits far better."""
    stayed, turned = about_center(0.0, 0.0), about_center(180.0, 0.0)
    poses = jaxlie.SE3(jnp.stack([turned.wxyz_xyz, stayed.wxyz_xyz]))
    for costs, best in (((0.10, 0.125), 1), ((0.10, 0.16), 0)):
        costs = jnp.asarray(costs)
        assert int(choose(costs, True)) == 0
        assert int(choose(costs + charged(poses, stayed, costs), True)) == best


def test_what_hardly_moved_stayed_if_that_fits_nearly_as_well_whatever_the_prior_says():
    """An aligned pose and "it did not move"; the prior prefers the former, as it does what was aligned."""
    stayed = about_center(20.0, 0.3)
    small, turned, shifted = (
        about_center(0.8 * NOT_TURNED_DEG, 0.5 * IN_PLACE),
        about_center(1.2 * NOT_TURNED_DEG, 0.5 * IN_PLACE),
        about_center(0.5 * NOT_TURNED_DEG, 1.5 * IN_PLACE),
    )
    near, far = jnp.asarray([0.3, 0.32]), jnp.asarray([0.3, 0.36])
    assert simply(near[1]) < near[0] < simply(far[1])
    for motion, costs, best in ((small, near, 1), (small, far, 0), (turned, near, 0), (shifted, near, 0)):
        poses = jaxlie.SE3(jnp.stack([(stayed @ motion).wxyz_xyz, stayed.wxyz_xyz]))
        moved = motion_since(stayed, poses, CENTER)
        first = choose(costs, True, jnp.asarray([0.1, 0.3]))
        assert int(first) == 0
        assert int(simplest(first, costs, moved)) == best
        assert int(simplest(jnp.asarray(1), costs, moved)) == 1
