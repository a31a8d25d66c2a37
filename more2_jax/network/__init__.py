"""The network (paper §3.1): encoder and decoder, their weights, and the published weights' names and layouts.

A `Prior` holds weights and settings; `encode` and `sdf` are its public doors. Imports `geometry`, `config` and `types`.
"""
