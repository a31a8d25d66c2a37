"""Single files as formats are made of: PLY, NPZ, JSON and depth sequences, or one line that says what is wrong.

May import `scans.labeled_cloud`, `types`.
"""
