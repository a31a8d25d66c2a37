"""A run on many devices, on two processes, or killed on its way is the run on one device that was let be."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest
from compiling import FLAGS, LITTLE
from places import ROOT
from sphere_shards import sphere_shards

from more2_jax.network.prior import load_prior
from train.run.devices import connect, cores, shares

# As few layers as there are kinds of them: these tests spend their time compiling.
SETTINGS = """
model:
  encoder: {widths: [8, 8, 8], code: 8, neighbors: 4, head_channels: 8, points: 32,
            downsample_blocks: [2], downsample_factors: [2]}
  decoder: {hidden: 32, layers: 3, skip_layer: 2, dropout: 0.1}
training: {steps: 60, batch: 8, learning_rate: 1.0e-3, queries: 32, raw_points: 64, max_views: 2, warmup_steps: 2,
           validate_every: 20, picture_every: 1000}
"""
FEW = SETTINGS.replace("steps: 60", "steps: 4").replace("validate_every: 20", "validate_every: 2")
MINUTES = 10  # a subprocess may take, on a machine that is busy

STEPS_ON_ONE_AND_FOUR = """
import dataclasses, json, sys
from pathlib import Path
import jax, numpy as np
from jax.sharding import Mesh
from more2_jax.config import load_config
from train.run.settings import TrainingRun
from more2_jax.network.prior import init_prior
from train.run.devices import ROWS, everywhere
from train.run.batches import resident
from train.run.shape_mix import open_mix
from train.run.state import initial_state, training_step

settings = load_config(sys.argv[1], TrainingRun)
mix = open_mix([Path(sys.argv[2])], "train")
found = {}
for count in (1, 4):
    mesh = Mesh(np.array(jax.devices()[:count]), (ROWS,))
    prior = init_prior(settings.model, jax.random.key(0))
    state = everywhere(mesh, initial_state(prior, settings.training))
    batches = resident(mix, settings.training, mesh)
    how = dict(model=settings.model, config=settings.training, mesh=mesh)
    step = training_step.lower(state, *next(batches(0)), **how).compile()
    losses = []
    for _, batch in zip(range(4), batches(0)):
        state, terms = step(state, *batch)
        losses.append({k: float(v) for k, v in terms.items()})
    flat = np.concatenate([np.ravel(x) for x in jax.tree.leaves(state.params)]).astype(float)
    found[count] = {"losses": losses, "params": flat.tolist(), "flops": step.cost_analysis()["flops"]}
print(json.dumps(found))
"""

LET_BE_BUT_COPIED_AT_ITS_FIRST_CHECKPOINT = """
import shutil, sys
from pathlib import Path
from train import prior

folder = Path(sys.argv[1])

def keep(manager, step, state, score=None, saved=prior.keep):
    saved(manager, step, state, score)
    manager.wait_until_finished()
    if not (folder / "stopped").exists():
        shutil.copytree(folder / "let_be", folder / "stopped")

prior.keep = keep
prior.main(folder / "settings.yaml", (folder,), folder / "let_be")
"""

CHOOSES_DEVICES = """
import sys
import jax
from train.run.devices import device_a_core, device_mesh, to_read
device_a_core(6, sys.argv[1])
copies = to_read(device_mesh(6), jax.numpy.ones(1000)).addressable_shards
print(len(copies), len({x.data.unsafe_buffer_pointer() for x in copies}))
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A folder with settings, shards, and `alone`: a run on one device that was let be."""
    folder = tmp_path_factory.mktemp("runs")
    (folder / "settings.yaml").write_text(SETTINGS)
    sphere_shards(folder)
    finish(started(folder, "alone"))
    return folder


def started(folder: Path, out: str, *more: str, devices: int = 1, quickly: bool = False) -> subprocess.Popen:
    files = ["--config", str(folder / "settings.yaml"), "--shards", str(folder), "--out", str(folder / out)]
    return program(["-m", "train.prior", *files, *more], devices, quickly)


def program(arguments: list[str], devices: int = 1, quickly: bool = False) -> subprocess.Popen:
    """A process with so many devices; `quickly`: that compiles as tests do, not as for users."""
    environment = os.environ | {
        LITTLE.upper(): str(quickly),
        "JAX_PLATFORMS": "cpu",
        "XLA_FLAGS": f"--xla_force_host_platform_device_count={devices} {FLAGS}",
        "PYTHONPATH": str(ROOT),
    }
    pipe = subprocess.PIPE
    return subprocess.Popen(
        [sys.executable, *arguments], cwd=ROOT, env=environment, stdout=pipe, stderr=pipe, text=True
    )


def finish(process: subprocess.Popen) -> str:
    out, err = process.communicate(timeout=60 * MINUTES)
    assert process.returncode == 0, err[-2000:]
    return out


def weights(path: Path) -> np.ndarray:
    return np.concatenate([np.ravel(x) for x in jax.tree.leaves(load_prior(path).params)])


@pytest.mark.slow
def test_four_devices_take_the_steps_of_one_each_doing_its_share(made):
    arguments = ["-c", STEPS_ON_ONE_AND_FOUR, str(made / "settings.yaml"), str(made)]
    found = json.loads(finish(program(arguments, devices=4)))
    one, four = found["1"], found["4"]
    for a, b in zip(one["losses"], four["losses"], strict=True):
        assert a == pytest.approx(b, rel=1e-3)
    off = np.abs(np.subtract(one["params"], four["params"]))
    # Adam divides by the gradient's size: a rounding error near zero can be as large as the rest of a step of 1e-3.
    assert np.median(off) < 1e-6 and np.quantile(off, 0.99) < 1e-4 and off.max() < 4e-3
    # By the compiler's count, which is of one device: the work is split, not repeated.
    assert four["flops"] < 0.28 * one["flops"]


@pytest.mark.begins
def test_in_short_a_run_on_two_devices_resumes_bit_for_bit(tmp_path):
    """What the slow tests beside it try at length: there runs are killed, here what one has on disk is copied."""
    (tmp_path / "settings.yaml").write_text(FEW)
    sphere_shards(tmp_path)
    finish(program(["-c", LET_BE_BUT_COPIED_AT_ITS_FIRST_CHECKPOINT, str(tmp_path)], 2, quickly=True))
    assert [x.name for x in (tmp_path / "stopped" / "checkpoints").iterdir() if x.name.isdigit()] == ["2"]
    assert len(logs(tmp_path, "stopped")[0]) == 1
    finish(started(tmp_path, "stopped", devices=2, quickly=True))
    for name in ("weights.npz", "best.npz"):
        np.testing.assert_array_equal(*(weights(tmp_path / k / name) for k in ("let_be", "stopped")))
    for a, b in zip(*logs(tmp_path, "let_be", "stopped"), strict=True):
        assert (a["step"], a["train"], a["val"]) == (b["step"], b["train"], b["val"])


@pytest.mark.slow
def test_two_processes_end_where_one_does(tmp_path):
    (tmp_path / "settings.yaml").write_text(FEW)
    sphere_shards(tmp_path)
    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    how = [("--coordinator", address, "--processes", "2", "--process", str(k)) for k in range(2)]
    for process in [started(tmp_path, "together", *more) for more in how]:
        finish(process)
    finish(started(tmp_path, "alone"))
    off = np.abs(np.subtract(*(weights(tmp_path / k / "weights.npz") for k in ("alone", "together"))))
    # Where a gradient is rounding alone, Adam makes a step of it all the same: 1e-3, four times.
    assert np.quantile(off, 0.99) < 1e-6 and off.max() < 4e-3
    alone, together = logs(tmp_path, "alone", "together")
    assert [x["step"] for x in alone] == [x["step"] for x in together] == [2, 4]
    for x, y in zip(alone, together, strict=True):
        assert x["train"] == pytest.approx(y["train"], rel=1e-5)
        assert x["val"] == pytest.approx(y["val"], rel=1e-4)


def kill_after_its_first_checkpoint(folder: Path, out: str, devices: int = 1) -> None:
    process = started(folder, out, devices=devices)
    checkpoints, end = folder / out / "checkpoints", time.monotonic() + 60 * MINUTES
    while not (checkpoints / "20").exists() and process.poll() is None and time.monotonic() < end:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    assert not (checkpoints / "60").exists(), "killed too late: this run was over"


def logs(folder: Path, *runs: str) -> list[list[dict]]:
    return [[json.loads(x) for x in (folder / k / "log.jsonl").read_text().splitlines()] for k in runs]


@pytest.mark.slow
def test_a_run_that_is_killed_and_resumed_ends_bit_for_bit_where_it_would_have(made):
    kill_after_its_first_checkpoint(made, "killed")
    finish(started(made, "killed"))
    for name in ("weights.npz", "best.npz"):
        np.testing.assert_array_equal(weights(made / "alone" / name), weights(made / "killed" / name))
    for a, b in zip(*logs(made, "alone", "killed"), strict=True):
        assert (a["step"], a["train"], a["val"]) == (b["step"], b["train"], b["val"])


@pytest.mark.slow
def test_a_run_goes_on_with_another_number_of_devices(made):
    kill_after_its_first_checkpoint(made, "moved", devices=4)
    finish(started(made, "moved"))
    for a, b in zip(*logs(made, "alone", "moved"), strict=True):
        assert a["step"] == b["step"]
        assert a["train"]["sdf"] == pytest.approx(b["train"]["sdf"], rel=1e-2)


@pytest.mark.slow
def test_last_and_best_are_kept(made):
    (log,) = logs(made, "alone")
    best = max(log, key=lambda line: line["val"]["score"])["step"]
    kept = {int(p.name) for p in (made / "alone" / "checkpoints").iterdir()}
    assert kept == {best, 60}


def test_a_batch_that_the_devices_cannot_share_is_refused_in_one_line(tmp_path):
    (tmp_path / "settings.yaml").write_text(SETTINGS)
    process = program(
        ["-m", "train.prior", "--config", str(tmp_path / "settings.yaml"), "--shards", str(tmp_path)]
        + ["--out", str(tmp_path / "x")],
        devices=3,
    )
    _, err = process.communicate(timeout=60 * MINUTES)
    assert (process.returncode, len(err.splitlines())) == (2, 1)
    assert "batch of 8 on 3 devices" in err


@pytest.mark.parametrize("batch", [1, 6, 7, 16])
@pytest.mark.parametrize("at_hand", [1, 2, 4, 100])
def test_as_many_cores_work_as_can_share_a_batch_evenly(batch, at_hand):
    n = shares(batch, at_hand)
    assert batch % n == 0 and n <= at_hand
    assert not any(batch % more == 0 for more in range(n + 1, min(batch, at_hand) + 1))


@pytest.mark.parametrize(
    ("environment", "coordinator", "wanted"),
    [
        ({}, "", shares(6, cores())),
        ({}, "localhost:1", 1),
        ({"JAX_COORDINATOR_ADDRESS": "auto"}, "", 1),
        ({"XLA_FLAGS": "--xla_force_host_platform_device_count=3"}, "", 3),
        ({"JAX_NUM_CPU_DEVICES": "3"}, "", 3),
    ],
)
def test_a_core_is_a_device_unless_the_user_has_chosen(environment, coordinator, wanted):
    kept = {k: v for k, v in os.environ.items() if k not in ("XLA_FLAGS", "JAX_NUM_CPU_DEVICES")}
    arguments = [sys.executable, "-c", CHOOSES_DEVICES, coordinator]
    how = {"env": kept | {"JAX_PLATFORMS": "cpu"} | environment, "capture_output": True, "text": True}
    ran = subprocess.run(arguments, cwd=ROOT, timeout=60 * MINUTES, **how)
    assert ran.stdout.split() == [str(wanted), "1"], ran.stderr[-2000:]


def test_a_process_that_is_none_of_them_is_refused():
    with pytest.raises(ValueError, match="process 2 of 2"):
        connect("localhost:1", 2, 2)
