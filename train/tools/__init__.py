"""Programs beside training: census, packing, widening, and the files that the package and the tests bundle.

Imports all other packages of train, and more2_jax.
"""
