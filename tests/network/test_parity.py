"""The network agrees with the published layers, and with the plain float64 form of its equations."""

import numpy as np
import oracles
import pytest
import torch_writer
from places import DATA

from more2_jax.network.parity import check_prior, read_reference, weights_of_reference
from more2_jax.network.torch_checkpoint import read_checkpoint

OUTPUTS = ("F_inv", "F_eqv", "F_s", "F_c", "sdf")


def largest_deviation(ours: dict, reference: dict) -> float:
    return max(np.abs(ours[n] - reference[n]).max() / np.abs(reference[n]).max() for n in OUTPUTS)


def test_network_agrees_with_the_published_layers():
    reference = read_reference(DATA / "reference_small.npz")
    deviation = check_prior(weights_of_reference(reference), reference)
    assert set(deviation) == set(OUTPUTS)
    assert max(deviation.values()) <= 1e-5, deviation


def test_oracle_agrees_with_the_published_layers():
    reference = read_reference(DATA / "reference_small.npz")
    first = {k: reference[k][:2] for k in ("points", "queries", *OUTPUTS)}
    ours = oracles.outputs(weights_of_reference(reference), first["points"], first["queries"])
    assert largest_deviation(ours, first) <= 1e-5


def test_checkpoint_that_torch_saved_agrees_with_what_torch_computed():
    reference = read_reference(DATA / "tiny_checkpoint_reference.npz")
    deviation = check_prior(read_checkpoint(DATA / "tiny_checkpoint.pt"), reference)
    assert max(deviation.values()) <= 1e-5, deviation


def test_a_center_is_off_by_shares_of_the_object():
    reference = read_reference(DATA / "reference_small.npz")
    weights, size = weights_of_reference(reference), reference["F_s"].max()
    assert np.abs(reference["F_c"]).max() < size
    off = reference | {"F_c": reference["F_c"] + np.float32(1e-3 * size)}
    assert check_prior(weights, off)["F_c"] == pytest.approx(1e-3, rel=0.01)


@pytest.mark.slow
def test_full_width_checkpoint_agrees_with_the_oracle(tmp_path):
    weights = oracles.random_weights((32, 32, 64, 64, 128, 256, 512), 256, 768, seed=0)
    assert sum(w.size for w in weights.values()) == 7_395_808  # the published size
    path = torch_writer.save(tmp_path / "full.pt", weights)
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.5, 0.5, (1, 1024, 3)).astype(np.float32) * [[[0.6, 1, 0.9]]]
    points = (points - points.mean(axis=1, keepdims=True)).astype(np.float32)
    # F_s of such weights is large: queries spread accordingly, so that sdf varies over them.
    code = oracles.encode(weights, points[0])
    queries = (code["F_s"] * rng.uniform(-0.5, 0.5, (1, 32, 3))).astype(np.float32)
    outputs = code | {"sdf": oracles.decode(weights, code, queries[0].astype(np.float64))}
    reference = {"points": points, "queries": queries} | {k: np.asarray(v)[None] for k, v in outputs.items()}
    assert np.ptp(reference["sdf"]) > 1e-3
    deviation = check_prior(read_checkpoint(path), reference)
    assert max(deviation.values()) <= 1e-5, deviation


def test_wrong_weights_are_noticed():
    reference = read_reference(DATA / "reference_small.npz")
    weights = weights_of_reference(reference)
    name = "network_dict.encoder.K_list.4.lin.weight"  # the least influential kind: keys of the attention
    weights[name] = -weights[name]
    assert max(check_prior(weights, reference).values()) > 1e-4


def test_reference_that_does_not_fit_is_refused(tmp_path):
    reference = read_reference(DATA / "reference_small.npz")
    weights = weights_of_reference(reference)
    plain = {k: reference[k] for k in ("points", "queries", *OUTPUTS)}
    with pytest.raises(ValueError, match="holds no weights"):
        weights_of_reference(plain)
    for change, said in (
        ({"F_eqv": plain["F_eqv"].swapaxes(1, 2)}, "F_eqv has shape"),
        ({"points": plain["points"][0]}, "needed points"),
        ({"points": plain["points"][:, :256]}, "256 reference points leave a block 8"),
        ({"F_inv": plain["F_inv"][:, :8], "F_eqv": plain["F_eqv"][:, :8]}, "of these weights has shape"),
    ):
        with pytest.raises(ValueError, match=said):
            check_prior(weights, plain | change)
    np.savez(tmp_path / "a.npz", points=plain["points"])
    with pytest.raises(ValueError, match="no array queries"):
        read_reference(tmp_path / "a.npz")
    (tmp_path / "a.npz").write_text("no npz")
    with pytest.raises(ValueError, match="not a readable NPZ"):
        read_reference(tmp_path / "a.npz")
