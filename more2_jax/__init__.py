"""Living scenes (MoRE², CVPR 2024) in JAX."""

__version__ = "0.1.0"
