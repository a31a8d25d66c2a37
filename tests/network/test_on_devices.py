"""Several devices: weights come to each once, and go with their last user; calls of scenes are shared out, too."""

import os
import subprocess
import sys
from functools import partial

import jax
import jax.numpy as jnp
from compiling import FLAGS
from places import ROOT

from more2_jax.network import on_devices

ON_FOUR = """
import gc
from functools import partial
import jax, jax.numpy as jnp, numpy as np
from more2_jax.network import on_devices
from more2_jax.network.row_map import chunked
from more2_jax.network.shared_calls import side_by_side

devices, seen = jax.local_devices(), []
product = jax.jit(lambda weights, rows: rows["x"] @ weights["w"])

def program(weights, rows):
    (device,) = rows["x"].devices()
    assert isinstance(rows["x"], jax.core.Tracer) or {device} == weights["w"].devices()
    seen.append(device)
    return product(weights, rows)

weights = {"w": jnp.arange(5.0), "name": np.ones(2)}
rows = {"x": np.random.default_rng(0).normal(size=(11, 5)).astype(np.float32)}

def close(found):
    np.testing.assert_allclose(found, rows["x"] @ np.arange(5.0), rtol=1e-5)

close(chunked(partial(program, weights), 2, rows))
assert seen == [devices[n % 4] for n in range(6)]

with jax.transfer_guard_device_to_device("disallow_explicit"):  # nothing is copied again
    close(chunked(partial(program, weights), 2, rows))
    try:
        on_devices.copied(jnp.ones(3), devices[1])
    except Exception as error:
        assert "device-to-device" in str(error), error
    else:
        raise AssertionError("copies are not noticed")

seen.clear()
with jax.default_device(devices[2]):  # a scene that has a device of its own stays there
    close(chunked(partial(program, weights), 2, rows))
    there = on_devices.at_hand(weights)["w"]
assert set(seen) == {devices[2]} == there.devices() and on_devices.at_hand(weights)["w"] is weights["w"]

seen.clear()
each = side_by_side(lambda k: chunked(partial(program, weights), 2, {"x": rows["x"][k : k + 1]}), range(8), 1)
close([*np.concatenate(each), *(rows["x"][8:] @ np.arange(5.0))])
assert len(seen) == 4 and set(seen) == set(devices)

del weights, there
gc.collect()
assert not on_devices._COPIES
print("held")
"""


def test_four_devices_have_the_weights_once_and_share_calls():
    environment = os.environ | {
        "XLA_FLAGS": f"--xla_force_host_platform_device_count=4 {FLAGS}",
        "JAX_PLATFORMS": "cpu",
        "PYTHONPATH": str(ROOT),
    }
    ran = subprocess.run(
        [sys.executable, "-c", ON_FOUR], env=environment, capture_output=True, text=True, timeout=300
    )
    assert ran.stdout == "held\n", ran.stderr[-2000:]


def test_what_is_no_array_or_is_there_already_stays_itself():
    (device, *_), array = jax.local_devices(), jnp.ones(3)
    for x in (array, 2.0, "name", None):
        assert on_devices.copied(x, device) is x
    assert not on_devices._COPIES
    plain = on_devices.placed(len, device)
    assert plain is len


def test_a_gradient_goes_through_a_placed_function():
    there = jax.local_devices()[0]

    def total(weight):
        return on_devices.placed(partial(jnp.multiply, weight), there)(jnp.arange(3.0)).sum()

    assert float(jax.grad(total)(2.0)) == 3.0
