"""What a program costs, counted from its equations: by definition, however it is nested."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eval import operations
from eval.operations import Count, count_of, counted, estimate_s
from more2_jax import encoding, meshing
from more2_jax.encoding import embed

A, B = np.ones((4, 3), np.float32), np.ones((3, 5), np.float32)
PRODUCT = Count(2 * 4 * 3 * 5, 4 * (12 + 15 + 20), 1)


def test_a_product_of_matrices():
    assert count_of(lambda a, b: a @ b, A, B) == PRODUCT
    assert count_of(jax.jit(lambda a, b: a @ b), A, B) == PRODUCT
    batched = count_of(jax.vmap(lambda a, b: a @ b), np.stack([A] * 7), np.stack([B] * 7))
    assert (batched.flops, batched.kernels) == (7 * PRODUCT.flops, 1)


def test_loops_count_as_often_as_they_turn():
    def loop(length):
        return lambda a, b: jax.lax.scan(lambda c, _: (c, a @ b), 0, length=length)[1]

    once, many = (count_of(loop(n), A, B) for n in (1, 9))
    assert (many.flops, many.kernels) == (9 * once.flops, 9 * once.kernels) == (9 * 120, 9)
    mapped = count_of(lambda a: jax.lax.map(lambda row: row @ B, a), A)
    assert (mapped.flops, mapped.kernels) == (120, 4)


def test_of_branches_the_dearest():
    both = count_of(lambda k, a: jax.lax.cond(k, lambda a: a @ B, lambda a: jnp.zeros((4, 5)), a), True, A)
    assert (both.flops, both.kernels) == (120, 1)


def test_what_only_moves_numbers_is_free_and_elementwise_work_joins_a_kernel():
    assert count_of(lambda a: a.reshape(-1), A) == Count()
    assert count_of(jnp.sin, A) == Count(12, 4 * 24, 0)


def test_a_loop_of_unknown_length_is_refused():
    with pytest.raises(ValueError, match="unknown length"):
        count_of(lambda x: jax.lax.while_loop(lambda x: x < 3, lambda x: x + 1, x), 0.0)


def test_estimates_are_of_the_slower_of_arithmetic_and_memory():
    arithmetic, memory = Count(flops=operations.FLOPS), Count(bytes=2 * operations.BYTES)
    assert estimate_s(arithmetic) == pytest.approx(1)
    assert estimate_s(arithmetic + memory) == pytest.approx(2)
    assert estimate_s(Count(kernels=3)) == pytest.approx(3 * operations.LAUNCH_S)


def test_programs_are_counted_where_the_stages_call_them(tiny_prior):
    clouds, before = [np.random.default_rng(0).normal(size=(300, 3))], (encoding.encode, meshing.CHUNK)
    alone = embed(tiny_prior, clouds)[0]
    with counted() as (stages, spent):
        twice = [embed(tiny_prior, clouds)[0] for _ in range(2)]
    assert (encoding.encode, meshing.CHUNK) == before
    np.testing.assert_array_equal(twice[1].inv, alone.inv)
    assert stages["encode"].flops > 0 and stages["mesh"] == Count() and spent["cpu"] > 0
    with counted() as (once, _):
        embed(tiny_prior, clouds)
    assert stages["encode"] == once["encode"].times(2)
