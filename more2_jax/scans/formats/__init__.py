"""The formats of scans, a module each; `registry` lists them, the most particular first.

May import `geometry.up_axis`, `scans.files`, `scans.instance_property`, `scans.labeled_cloud`, `scans.large_instances`,
`scans.segment_groups`, `scans.structural_labels`, `types`.
"""
