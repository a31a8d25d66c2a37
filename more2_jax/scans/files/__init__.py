"""Files that several formats are made of: PLY, NPZ, JSON, RGB-D sequences; errors are one line each.

Imports nothing of the package but types.
"""
