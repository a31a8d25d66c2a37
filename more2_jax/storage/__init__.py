"""The living-scene folder: written whole or not at all, read back as it was; and the PLY files in it.

The page that lies beside is given as text: storing a scene draws nothing.
May import `scans`, `config`, `progress`, `types`, `whole_file`.
"""
