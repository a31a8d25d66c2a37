"""Instances are named by whole numbers of any type, as CloudCompare and others store them, and by nothing else."""

from pathlib import Path

import numpy as np
import pytest

from more2_jax.scans.instance_property import as_whole, instance_of, is_whole
from more2_jax.scans.labeled_cloud import ReadOptions

NAN = np.nan


@pytest.mark.parametrize(
    ("values", "whole"),
    [
        (np.array([0, 3], np.uint16), True),
        (np.array([0.0, 3.0], np.float32), True),
        (np.array([-1.0, 2.0**40]), True),
        (np.array([NAN, 3.0]), True),
        (np.array([0.0, 3.5]), False),
        (np.array([NAN, NAN]), False),
        (np.array([1.0, np.inf]), False),
        (np.array([1.0, 2.0**60]), False),
    ],
)
def test_whole_numbers_are_told_by_their_values(values, whole):
    assert is_whole(values) == whole


def test_what_was_not_set_is_background():
    np.testing.assert_array_equal(as_whole(np.array([NAN, 3.0, -1.0])), [0, 3, -1])
    assert as_whole(np.array([NAN, 3.0])).dtype == np.int64


def chosen(asked=None, needed=True, others=(), **properties):
    options = ReadOptions(instance_property=asked, masks_needed=needed)
    return instance_of(Path("a.ply"), properties, others, options, "vertex property")


ONE, TWO, SHARES = np.array([1, 1, 2]), np.array([1.0, NAN, 2.0], np.float32), np.array([0.1, 0.2, 0.3])


def test_the_first_of_the_usual_names_is_taken_with_or_without_the_prefix():
    name, values = chosen(label=ONE, scalar_instance=TWO)
    assert name == "scalar_instance"
    np.testing.assert_array_equal(values, [1, 0, 2])
    assert chosen(instance=ONE, scalar_instance=TWO)[0] == "instance"  # the plain name first


@pytest.mark.parametrize("asked", ["segment", "scalar_segment"])
def test_another_name_may_be_asked_for_with_or_without_the_prefix(asked):
    assert chosen(asked, instance=ONE, scalar_segment=TWO)[0] == "scalar_segment"


def test_shares_and_colors_name_no_instance():
    assert chosen(needed=False, instance=SHARES) is None
    assert chosen(needed=False, others=("label",), label=ONE) is None
    with pytest.raises(
        ValueError, match=r"^a.ply: no integer vertex property instance or .*; it has no integer property"
    ):
        chosen(instance=SHARES)
    with pytest.raises(
        ValueError, match=r"no integer vertex property red names .*; integer properties are label"
    ):
        chosen("red", others=("red",), red=ONE, label=ONE)
