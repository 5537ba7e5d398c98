"""Articulated assets (URDF, MJCF) rendered as scenes of the benchmarks: ``p2gs data render``."""
