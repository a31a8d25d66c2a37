"""Scans as they come: readers of the formats, instance masks, segmentation where there are none, inspection.

Everything becomes one labeled cloud, and that a scan. Imports types, config and geometry.
"""
