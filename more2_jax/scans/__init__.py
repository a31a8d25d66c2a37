"""Scans as people have them, read into a `Scan`: formats, masks, segmentation, and what a scan holds.

`read_scan` is the door; readers know files and no method.
May import `geometry`, `config`, `types`.
"""
