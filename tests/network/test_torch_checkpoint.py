"""Checkpoints come back to the bit, whatever else they hold, and nothing inside them is ever run."""

import os
import pickle
import zipfile
from pathlib import Path

import ml_dtypes
import numpy as np
import pytest
import torch_writer as writer
from places import DATA

from more2_jax.network.torch_checkpoint import read_checkpoint

RNG = np.random.default_rng(0)
WEIGHTS = {"a.weight": RNG.normal(size=(3, 4)).astype(np.float32), "a.bias": np.arange(3, dtype=np.float32)}


def fails(path: Path) -> str:
    with pytest.raises(ValueError, match=r".") as error:
        read_checkpoint(path)
    assert "\n" not in str(error.value) and path.name in str(error.value)
    return str(error.value)


def assert_same(ours: dict, theirs: dict) -> None:
    assert list(ours) == list(theirs)
    for name, array in theirs.items():
        assert ours[name].dtype == array.dtype
        np.testing.assert_array_equal(ours[name], array)


def test_checkpoint_that_torch_saved():
    weights = read_checkpoint(DATA / "tiny_checkpoint.pt")
    assert len(weights) == 78
    assert {w.dtype for w in weights.values()} == {np.dtype(np.float32)}
    assert weights["network_dict.encoder.V_list.0.lin.weight"].shape == (16, 3)
    assert all(np.isfinite(w).all() and np.ptp(w) > 0 for w in weights.values() if w.size > 1)


@pytest.mark.parametrize("order", ["little", "big"])
@pytest.mark.parametrize("kind", [*writer.STORAGES])
def test_every_dtype_in_either_byte_order(tmp_path, kind, order):
    dtype = np.dtype(ml_dtypes.bfloat16) if kind == "bfloat16" else np.dtype(kind)
    weights = {"w": (10 * RNG.random((2, 5))).astype(dtype), "scalar": np.array(3).astype(dtype)}
    assert_same(read_checkpoint(writer.save(tmp_path / "a.pt", weights, order=order)), weights)


def test_without_a_byteorder_record_it_is_little(tmp_path):
    body = writer.mapping(
        {"model_state_dict": writer.mapping({"w": writer.tensor("0", "float32", 2, 0, (2,), (1,))})}
    )
    raw = {"0": np.array([1, 2], "<f4").tobytes()}
    path = writer.write_raw(tmp_path / "a.pt", body, raw, root="any name/", order=None)
    np.testing.assert_array_equal(read_checkpoint(path)["w"], [1, 2])


def state(
    tmp_path: Path, *, elements: int, offset: int, shape: tuple, strides: tuple, stored: int = 12
) -> Path:
    tensor = writer.tensor("7", "float32", elements, offset, shape, strides)
    body = writer.mapping({"model_state_dict": writer.mapping({"w": tensor})})
    return writer.write_raw(tmp_path / "a.pt", body, {"7": np.arange(stored, dtype="<f4").tobytes()})


def test_strides_and_offsets_are_honored(tmp_path):
    whole = np.arange(12, dtype=np.float32)
    for offset, shape, strides, expected in (
        (0, (4, 3), (1, 4), whole.reshape(3, 4).T),
        (2, (2, 3), (4, 1), np.array([[2, 3, 4], [6, 7, 8]])),
        (11, (), (), whole[11]),
        (5, (0, 3), (3, 1), np.zeros((0, 3))),
    ):
        path = state(tmp_path, elements=12, offset=offset, shape=shape, strides=strides)
        np.testing.assert_array_equal(read_checkpoint(path)["w"], expected)


@pytest.mark.parametrize(
    "layout",
    [
        {"elements": 12, "offset": 10, "shape": (3,), "strides": (1,)},
        {"elements": 12, "offset": 0, "shape": (3, 3), "strides": (5, 1)},
        {"elements": 12, "offset": -1, "shape": (2,), "strides": (1,)},
        {"elements": 12, "offset": 0, "shape": (2,), "strides": (-1,)},
        {"elements": 12, "offset": 0, "shape": (2, 2), "strides": (1,)},
        {"elements": 99, "offset": 0, "shape": (2,), "strides": (1,)},
        {"elements": 12, "offset": 0, "shape": (30000, 30000), "strides": (0, 0)},
    ],
)
def test_a_tensor_outside_its_storage_is_refused(tmp_path, layout):
    assert "tensor of" in fails(state(tmp_path, **layout))


# --- nothing is run -------------------------------------------------------------------------------------------


class Attack:
    """Pickles to a call of `function`."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


def attacks(target: Path) -> list[Attack]:
    code = f"open({str(target)!r}, 'w').close()"
    return [
        Attack(os.system, f"touch '{target}'"),
        Attack(eval, code),
        Attack(exec, code),
        Attack(getattr, "a", "upper"),
        Attack(os.mkdir, str(target)),
        Attack(Path.touch, target),
    ]


@pytest.mark.parametrize("which", range(6))
def test_code_in_a_checkpoint_does_not_run(tmp_path, which):
    target = tmp_path / "owned"
    attack = attacks(target)[which]
    pickle.loads(pickle.dumps(attack))  # the attack works on a plain unpickler
    if which != 3:
        assert target.exists()
        target.rmdir() if target.is_dir() else target.unlink()
    path = writer.save(tmp_path / "a.pt", WEIGHTS, extra=writer.pickled(attack))
    assert_same(read_checkpoint(path), WEIGHTS)
    body = writer.mapping({"model_state_dict": writer.mapping({"w": writer.pickled(attack)})})
    assert "no plain tensor" in fails(writer.write_raw(tmp_path / "b.pt", body, {}))
    assert "model_state_dict" in fails(writer.write_raw(tmp_path / "c.pt", writer.pickled(attack), {}))
    assert not target.exists()


def test_known_names_cannot_be_reached_through(tmp_path):
    """Names with dots, builders given nonsense, and state set on what they return."""
    for body in (
        writer.name("collections", "OrderedDict.__class__") + b")R",
        writer.name("torch._utils", "_rebuild_tensor_v2.__globals__"),
        writer.name("torch._utils", "_rebuild_tensor_v2") + b")R",
        writer.name("torch._utils", "_rebuild_tensor_v2") + b"(K\x01K\x02K\x03K\x04tR",
        writer.name("torch", "FloatStorage") + b")R",
        writer.name("os", "system") + b"}" + writer.text("x") + b"K\x01sb",
    ):
        content = writer.mapping({"model_state_dict": writer.mapping({"w": body})})
        fails(writer.write_raw(tmp_path / "a.pt", content, {}))
    assert os.system.__class__.__name__ == "builtin_function_or_method"
    assert_same(read_checkpoint(writer.save(tmp_path / "b.pt", WEIGHTS)), WEIGHTS)


class Config(dict):
    """A class of its own, with items and state, as training programs leave in checkpoints."""


def test_junk_beside_the_weights_does_not_matter(tmp_path):
    config = Config(lr=1e-4)
    config.note = "state"
    junk = [
        config,
        np.float64(3),
        np.arange(4),
        {1, 2},
        Path("a"),
        slice(3),
        1 + 2j,
        None,
        b"bytes",
        {"epoch": 7},
    ]
    path = writer.save(tmp_path / "a.pt", WEIGHTS, extra=writer.pickled(junk))
    assert_same(read_checkpoint(path), WEIGHTS)


def test_storages_of_other_entries_are_not_read(tmp_path):
    elsewhere = writer.mapping({"exp_avg": writer.tensor("not there", "float32", 10**9, 0, (10**9,), (1,))})
    assert_same(read_checkpoint(writer.save(tmp_path / "a.pt", WEIGHTS, extra=elsewhere)), WEIGHTS)


def test_parameters_are_tensors(tmp_path):
    inner = writer.tensor("0", "float32", 2, 0, (2,), (1,))
    parameter = writer.name("torch._utils", "_rebuild_parameter") + b"(" + inner + b"\x88"
    parameter += writer.name("collections", "OrderedDict") + b")RtR"
    body = writer.mapping({"model_state_dict": writer.mapping({"w": parameter})})
    path = writer.write_raw(tmp_path / "a.pt", body, {"0": np.array([1, 2], "<f4").tobytes()})
    np.testing.assert_array_equal(read_checkpoint(path)["w"], [1, 2])


# --- files that are no checkpoints ------------------------------------------------------------------------------


def test_files_that_are_no_checkpoint(tmp_path):
    path = tmp_path / "a.pt"
    assert "no such file" in fails(path)
    path.write_bytes(pickle.dumps({"model_state_dict": {}}))
    assert "before zip" in fails(path)
    for content in (b"", b"hello"):
        path.write_bytes(content)
        assert "not a zip file" in fails(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("readme", "hello")
    assert "no data.pkl" in fails(path)


def test_a_checkpoint_without_model_state_dict_says_what_it_holds(tmp_path):
    body = writer.pickled({"state_dict": 1, "epoch": 3})
    message = fails(writer.write_raw(tmp_path / "a.pt", body, {}))
    assert "state_dict, epoch" in message and "needed model_state_dict" in message


def test_a_refused_tensor_class_is_named(tmp_path):
    tensor = writer.tensor("0", "QInt8Storage", 2, 0, (2,), (1,))
    body = writer.mapping({"model_state_dict": writer.mapping({"w": tensor})})
    assert "torch.QInt8Storage" in fails(writer.write_raw(tmp_path / "a.pt", body, {"0": b"ab"}))


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.999])
def test_truncated(tmp_path, share):
    whole = (DATA / "tiny_checkpoint.pt").read_bytes()
    path = tmp_path / "a.pt"
    path.write_bytes(whole[: int(share * len(whole))])
    fails(path)


def test_damaged_anywhere_is_an_error_or_harmless(tmp_path):
    whole = writer.save(tmp_path / "a.pt", WEIGHTS).read_bytes()
    path = tmp_path / "b.pt"
    refused = 0
    for _ in range(300):
        damaged = bytearray(whole)
        damaged[RNG.integers(len(whole))] = RNG.integers(256)
        path.write_bytes(damaged)
        try:
            read_checkpoint(path)
        except ValueError as error:
            refused += "\n" not in str(error)
    assert refused > 50
