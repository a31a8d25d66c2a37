"""Seconds of tracing and compiling by program, from JAX's own events."""

import io

import jax
import jax.numpy as jnp
from rich.console import Console

from eval.compile_seconds import measured, table


def test_every_program_that_is_made_is_counted_once():
    @jax.jit
    def cube_of_everything(x):
        return x**3

    def work() -> int:
        for size in (3, 4, 3):
            cube_of_everything(jnp.zeros(size)).block_until_ready()
        return 7

    code, programs, total = measured(work)
    assert code == 7
    made = programs["cube_of_everything"]
    assert made.compiled == 2  # a shape each; the third call finds the first's
    assert all(seconds > 0 for seconds in made.wall.values())
    assert 0 < made.cpu["compile"] <= total

    page = io.StringIO()
    Console(file=page, width=120).print(table(programs, total))
    assert "cube_of_everything" in page.getvalue()

    _, again, _ = measured(work)
    assert "cube_of_everything" not in again  # compiled already: no event
