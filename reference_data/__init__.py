"""Installed as ``tsdf.reference_data``."""
