"""The largest begin first, and equal ones keep their order."""

from more2_jax.workers.largest_first import bytes_of, largest_first


def test_tasks_are_ordered_by_the_bytes_of_what_they_read(tmp_path):
    for name, size in (("a", 5), ("b", 30), ("c", 5), ("folder/deep/d", 20), ("folder/e", 20)):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"x" * size)
    files = {"one": ["a"], "two": ["b"], "also one": ["c"], "gone": ["none"], "all": ["folder", "a"]}
    found = largest_first(files, lambda task: [tmp_path / name for name in files[task]])
    assert found == ["all", "two", "one", "also one", "gone"]
    assert bytes_of(tmp_path / "folder") == 40
