"""Evaluation: a program a question (`python -m eval.end_to_end …`); folders hold what programs are built of.

Not packaged with the library. May import `train`, `more2_jax`.
"""

import os

# Before NumPy is imported. Matrices are small here: threads of one product wait for one another, which on a busy
# machine costs more than the product (docs/developing/notebook/speed_same_scene.md).
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
