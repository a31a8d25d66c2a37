"""The formats of scans, a module each; `registry` lists them, the most particular first.

May import `scans.files`, `scans.instance_property`, `scans.labeled_cloud`, `scans.segment_groups`,
`scans.structural_labels`, `types`.
"""
