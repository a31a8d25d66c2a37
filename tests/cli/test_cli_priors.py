"""`more2 prior …` from outside."""

import dataclasses

import jax
import numpy as np
import pytest
from command_line import refused

from more2_jax.cli.main import main
from more2_jax.network.prior import load_prior


def test_prior_info(tiny, capsys):
    assert main(["prior", "info", str(tiny)]) == 0
    told = capsys.readouterr().out
    parameters = sum(leaf.size for leaf in jax.tree.leaves(load_prior(tiny).params))
    assert f"tiny: {parameters:,} parameters" in told
    assert "code: 16" in told


def test_prior_list_names_what_is_shipped(tiny, capsys, monkeypatch):
    prior = load_prior(tiny)
    monkeypatch.setattr("more2_jax.network.prior.shipped_priors", lambda: ["one", "two"])
    monkeypatch.setattr("more2_jax.network.prior.load_prior", lambda name: prior)
    assert main(["prior", "list"]) == 0
    told = capsys.readouterr().out
    assert "one" in told
    assert "two" in told
    monkeypatch.setattr("more2_jax.network.prior.shipped_priors", list)
    assert main(["prior", "list"]) == 0
    assert "no weights are shipped" in capsys.readouterr().out


GOOD = {"F_inv": 1e-7, "F_eqv": 2e-7, "F_s": 0.0, "F_c": 3e-7, "sdf": 9.9e-6}


@pytest.mark.parametrize(
    ("deviations", "code"),
    [
        (GOOD, 0),
        (GOOD | {"F_c": 1e-5}, 1),
        (GOOD | {"sdf": float("nan")}, 1),
        (GOOD | {"F_s": float("inf")}, 1),
    ],
)
@pytest.mark.parametrize("alone", [True, False])
def test_prior_check_passes_only_below_the_limit(monkeypatch, capsys, deviations, code, alone):
    reference, inside, outside = {"points": 1}, {"weights": "inside"}, {"weights": "outside"}
    asked = []
    stand_ins = {
        "read_reference": lambda path: asked.append(path.name) or reference,
        "weights_of_reference": lambda arrays: inside,
        "read_checkpoint": lambda path: outside,
        "check_prior": lambda weights, arrays: asked.append(weights) or deviations,
    }
    for name, stand_in in stand_ins.items():
        home = "torch_checkpoint" if name == "read_checkpoint" else "parity"
        monkeypatch.setattr(f"more2_jax.network.{home}.{name}", stand_in)
    files = ["reference.npz"] if alone else ["published.pt", "reference.npz"]
    assert main(["prior", "check", *files]) == code
    assert asked == ["reference.npz", inside if alone else outside]
    told = capsys.readouterr().out
    assert all(f"{name:6} {value:.2e}" in told for name, value in deviations.items())


def test_prior_import_writes_full_precision_once(tmp_path, tiny, monkeypatch, capsys):
    half = load_prior(tiny)
    exact = dataclasses.replace(half, params=jax.tree.map(lambda v: v / 3, half.params))
    monkeypatch.setattr("more2_jax.network.torch_checkpoint.read_checkpoint", lambda path: {"read": path})
    converted = "more2_jax.network.published_weights.prior_from_published"
    monkeypatch.setattr(converted, lambda weights, name: dataclasses.replace(exact, name=name))
    out = tmp_path / "deep/mine.npz"
    assert main(["prior", "import", "published.pt", str(out)]) == 0
    again = load_prior(out)
    assert again.name == "mine"
    jax.tree.map(np.testing.assert_array_equal, again.params, exact.params)
    assert [p.name for p in out.parent.iterdir()] == ["mine.npz"]
    capsys.readouterr()
    assert "exists" in refused(capsys, "prior", "import", "published.pt", out)
    assert "needed .npz" in refused(capsys, "prior", "import", "published.pt", tmp_path / "mine.pt")


def test_prior_import_of_no_checkpoint(tmp_path, capsys):
    assert "no such file" in refused(capsys, "prior", "import", tmp_path / "none.pt", tmp_path / "out.npz")
    (tmp_path / "text.pt").write_text("hello")
    refused(capsys, "prior", "import", tmp_path / "text.pt", tmp_path / "out.npz")
    assert not (tmp_path / "out.npz").exists()
