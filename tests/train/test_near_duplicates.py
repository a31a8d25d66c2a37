"""Near-duplicates across splits: found whatever the quarter turn, kept in the split that must stay whole."""

import numpy as np
import pytest

from train.furniture.near_duplicates import nearest_twins, twins_across_splits


@pytest.fixture
def prints() -> np.ndarray:
    return np.random.default_rng(0).normal(0, 0.1, (6, 8, 8, 8)).astype(np.float32)


def test_a_turned_copy_is_found_and_its_difference_is_the_mean(prints: np.ndarray):
    copy = np.rot90(prints[3], 3, axes=(0, 1)) + 0.002
    index, difference = nearest_twins(copy[None], prints)
    assert index[0] == 3
    np.testing.assert_allclose(difference, 0.002, atol=1e-6)


def test_against_a_plain_loop(prints: np.ndarray):
    index, difference = nearest_twins(prints[:2], prints[2:])
    for k in range(2):
        table = [
            [np.abs(np.rot90(prints[k], t, axes=(0, 1)) - other).mean() for t in range(4)]
            for other in prints[2:]
        ]
        assert index[k] == np.argmin(np.min(table, axis=1))
        np.testing.assert_allclose(difference[k], np.min(table), rtol=1e-5)


def test_a_mirror_image_is_no_copy(prints: np.ndarray):
    _, difference = nearest_twins(prints[:1, ::-1], prints[:1])
    assert difference[0] > 0.01


def test_who_leaves(prints: np.ndarray):
    a, b, c = prints[0], prints[1], prints[2]
    rows = {
        "train_like_test": ("train", a),
        "test": ("test", a + 0.001),
        "val_like_train": ("val", b),
        "train": ("train", b - 0.001),
        "val_alone": ("val", c),
        "train_twice": ("train", b + 0.001),  # within one split copies may stay
    }
    names, splits = list(rows), [s for s, _ in rows.values()]
    found = {t.name: t for t in twins_across_splits(names, splits, np.stack([p for _, p in rows.values()]))}
    assert set(found) == {"train_like_test", "val_like_train"}
    assert (found["train_like_test"].of, found["train_like_test"].of_split) == ("test", "test")
    assert found["val_like_train"].of_split == "train"


def test_nothing_to_compare(prints: np.ndarray):
    assert twins_across_splits(["a", "b"], ["train", "train"], prints[:2]) == []
